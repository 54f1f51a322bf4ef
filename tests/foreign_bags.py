"""Recordings as other programs write them: ROS 2, protobuf and JSON, by their own writers and encoders."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import Writer
from mcap_ros2._dynamic import serialize_dynamic

from lfd.record import cdr

START_NS = 1_757_502_238_482_648_699
TYPES = cdr.DEFINITIONS | {
    "sensor_msgs/msg/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/msg/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "std_msgs/msg/Bool": "bool data",
    "std_msgs/msg/Float64": "float64 data",
    "std_msgs/msg/Int32MultiArray": "std_msgs/MultiArrayLayout layout\nint32[] data",
}


def definition(message_type: str) -> str:
    """A ROS 2 type with those that it uses, as a bag holds it."""
    text, waiting, seen = TYPES[message_type], [message_type], {message_type}
    while waiting:
        for line in TYPES[waiting.pop()].splitlines():
            package, slash, name = line.split()[0].removesuffix("[]").partition("/")
            if slash and (used := f"{package}/msg/{name}") not in seen:
                seen.add(used)
                waiting.append(used)
                text += f"\n{'=' * 80}\nMSG: {package}/{name}\n{TYPES[used]}"
    return text


@dataclass
class Stream:
    """One topic of a file to be."""

    topic: str
    schema: str
    encoding: str
    schema_encoding: str
    definition: bytes
    messages: list[tuple[int, bytes]] = field(default_factory=list)
    about: dict[str, str] = field(default_factory=dict)


def ros(topic: str, message_type: str, messages: Iterable[tuple[int, Any]], **about: str) -> Stream:
    """A topic of ROS 2: log times [ns] and messages as dictionaries, or as bytes."""
    text = definition(message_type)
    encode = serialize_dynamic(message_type, text)[message_type]
    encoded = [(time, m if isinstance(m, bytes) else encode(m)) for time, m in messages]
    return Stream(topic, message_type, "cdr", "ros2msg", text.encode(), encoded, about)


def as_json(topic: str, schema: str, messages: Iterable[tuple[int, Any]]) -> Stream:
    """A topic in JSON."""
    encoded = [(time, json.dumps(message).encode()) for time, message in messages]
    return Stream(topic, schema, "json", "jsonschema", b'{"type": "object"}', encoded)


def header(stamp_ns: int, frame: str = "") -> dict[str, Any]:
    """std_msgs/Header."""
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def joint_state(stamp_ns: int, names: Iterable[str], position: Iterable[float], frame: str = "") -> dict[str, Any]:
    """sensor_msgs/JointState without efforts."""
    position = [float(x) for x in position]
    return {
        "header": header(stamp_ns, frame),
        "name": list(names),
        "position": position,
        "velocity": [0.0] * len(position),
        "effort": [],
    }


def pose(stamp_ns: int, position: Iterable[float], wxyz: Iterable[float], frame: str = "base") -> dict[str, Any]:
    """geometry_msgs/PoseStamped."""
    w, x, y, z = map(float, wxyz)
    return {
        "header": header(stamp_ns, frame),
        "pose": {
            "position": dict(zip("xyz", map(float, position), strict=True)),
            "orientation": {"x": x, "y": y, "z": z, "w": w},
        },
    }


def array(values: Iterable[float], labels: str | None = None) -> dict[str, Any]:
    """std_msgs/Float64MultiArray."""
    values = [float(x) for x in values]
    dim = [] if labels is None else [{"label": labels, "size": len(values), "stride": len(values)}]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": values}


def write_file(path: Path, *streams: Stream) -> Path:
    """A finished MCAP file, messages in the order of their log times; those of a topic stay as they are."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        waiting = []
        for topic in streams:
            schema = 0
            if topic.schema:
                schema = writer.register_schema(topic.schema, topic.schema_encoding, topic.definition)
            channel = writer.register_channel(topic.topic, topic.encoding, schema, topic.about)
            latest = 0
            for time, data in topic.messages:
                latest = max(latest, time)
                waiting.append((latest, time, channel, data))
        for _, time, channel, data in sorted(waiting, key=lambda message: message[0]):
            writer.add_message(channel, time, data, time)
        writer.finish()
    return path


def stamps(seconds: np.ndarray, start_ns: int = START_NS) -> list[int]:
    """Times [s] as nanoseconds since the epoch."""
    return [start_ns + round(float(s) * 1e9) for s in seconds]


def protobuf_class(package: str, name: str, fields: dict[str, str]) -> tuple[Any, bytes]:
    """A message class with `double`, `repeated double` and `bytes` fields, and its FileDescriptorSet."""
    file = FileDescriptorProto(name=f"{package}/{name}.proto", package=package, syntax="proto3")
    message = file.message_type.add(name=name)
    kinds = {"double": 1, "string": 9, "bytes": 12, "fixed32": 7}
    for number, (field_name, kind) in enumerate(fields.items(), start=1):
        repeated, _, plain = kind.rpartition(" ")
        message.field.add(name=field_name, number=number, type=kinds[plain], label=3 if repeated else 1)
    pool = DescriptorPool()
    pool.Add(file)
    made = GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}"))
    return made, FileDescriptorSet(file=[file]).SerializeToString()
