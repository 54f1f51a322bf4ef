"""ROS 2 messages as bytes: the plain CDR encoding (little endian) of the few types that a recording uses.

Every value is aligned to its own size, counted from the end of the four-byte encapsulation header; strings
and sequences carry their length, strings a closing zero (OMG DDS-XTypes, plain CDR, version 1).
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

HEADER = b"\x00\x01\x00\x00"  # little endian, no options

DEFINITIONS: dict[str, str] = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/msg/String": "string data",
    "std_msgs/msg/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/msg/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "std_msgs/msg/Float64MultiArray": "std_msgs/MultiArrayLayout layout\nfloat64[] data",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/msg/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "rcl_interfaces/msg/Log": (
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line"
    ),
}
"""Message types and their fields."""


def schema_text(message_type: str) -> str:
    """The definition of a type followed by those that it uses, as MCAP's `ros2msg` encoding wants it."""
    text, seen, waiting = DEFINITIONS[message_type], {message_type}, [message_type]
    while waiting:
        for line in DEFINITIONS[waiting.pop(0)].splitlines():
            package, slash, name = line.split()[0].removesuffix("[]").partition("/")
            used = f"{package}/msg/{name}"
            if slash and used not in seen:
                seen.add(used)
                waiting.append(used)
                text += f"\n{'=' * 80}\nMSG: {package}/{name}\n{DEFINITIONS[used]}"
    return text + "\n"


class Packer:
    """Appends values to a message."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def pack(self, code: str, *values: float) -> "Packer":
        """Values of one `struct` code, aligned."""
        self._bytes += bytes(-len(self._bytes) % struct.calcsize(code))
        self._bytes += struct.pack(f"<{len(values)}{code}", *values)
        return self

    def text(self, value: str) -> "Packer":
        encoded = value.encode() + b"\x00"
        self.pack("I", len(encoded))
        self._bytes += encoded
        return self

    def doubles(self, values: np.ndarray) -> "Packer":
        """A sequence of float64."""
        self.pack("I", len(values))
        if len(values):
            self._bytes += bytes(-len(self._bytes) % 8)
            self._bytes += np.ascontiguousarray(values, dtype="<f8").tobytes()
        return self

    def octets(self, values: bytes) -> "Packer":
        """A sequence of uint8."""
        self.pack("I", len(values))
        self._bytes += values
        return self

    def stamp(self, time_ns: int) -> "Packer":
        return self.pack("i", time_ns // 10**9).pack("I", time_ns % 10**9)

    def finish(self) -> bytes:
        return HEADER + bytes(self._bytes)


class Unpacker:
    """Takes values from a message.

    Raises `ValueError` for bytes that end too soon or carry another encapsulation.
    """

    def __init__(self, data: bytes) -> None:
        if data[:4] != HEADER:
            raise ValueError(f"encapsulation header {data[:4].hex()}, expected {HEADER.hex()} (little-endian CDR)")
        self._data, self._at = memoryview(data)[4:], 0

    def _take(self, size: int, alignment: int) -> memoryview:
        start = self._at + -self._at % alignment
        if start + size > len(self._data):
            raise ValueError(f"the message ends after {len(self._data)} bytes, {start + size} are needed")
        self._at = start + size
        return self._data[start : self._at]

    def unpack(self, code: str) -> int:
        size = struct.calcsize(code)
        return struct.unpack(f"<{code}", self._take(size, size))[0]

    def text(self) -> str:
        return bytes(self._take(self.unpack("I"), 1))[:-1].decode()

    def octets(self) -> bytes:
        """A sequence of uint8."""
        return bytes(self._take(self.unpack("I"), 1))

    def doubles(self, count: int | None = None) -> np.ndarray:
        """A sequence of float64, or `count` single ones in a row."""
        size = self.unpack("I") if count is None else count
        return np.frombuffer(self._take(8 * size, 8 if size else 1), dtype="<f8").copy()

    def stamp(self) -> int:
        seconds = self.unpack("i")
        return seconds * 10**9 + self.unpack("I")


@dataclass(frozen=True)
class JointState:
    """Positions, velocities and efforts of named joints."""

    name: tuple[str, ...]
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


def pack_joint_state(time_ns: int, state: JointState) -> bytes:
    """sensor_msgs/JointState."""
    packer = Packer().stamp(time_ns).text("").pack("I", len(state.name))
    for name in state.name:
        packer.text(name)
    return packer.doubles(state.position).doubles(state.velocity).doubles(state.effort).finish()


def unpack_joint_state(data: bytes) -> JointState:
    """sensor_msgs/JointState."""
    message = Unpacker(data)
    message.stamp()
    message.text()
    names = tuple(message.text() for _ in range(message.unpack("I")))
    return JointState(names, message.doubles(), message.doubles(), message.doubles())


def pack_pose(time_ns: int, position: np.ndarray, xyzw: np.ndarray) -> bytes:
    """geometry_msgs/PoseStamped in the frame `world`."""
    packer = Packer().stamp(time_ns).text("world")
    return packer.pack("d", *position, *xyzw).finish()


def unpack_pose(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """geometry_msgs/PoseStamped: position [m] and quaternion xyzw."""
    message = Unpacker(data)
    message.stamp()
    message.text()
    return message.doubles(3), message.doubles(4)


def pack_transforms(time_ns: int, frames: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> bytes:
    """tf2_msgs/TFMessage: (child frame, position, xyzw) of frames in `world`."""
    packer = Packer().pack("I", len(frames))
    for child, position, xyzw in frames:
        packer.stamp(time_ns).text("world").text(child).pack("d", *position, *xyzw)
    return packer.finish()


def pack_array(labels: Sequence[str], values: np.ndarray) -> bytes:
    """std_msgs/Float64MultiArray with the names of the components, comma-separated, as its dimension's label."""
    packer = Packer().pack("I", 1).text(",".join(labels)).pack("I", len(values), len(values), 0)
    return packer.doubles(values).finish()


def unpack_array(data: bytes) -> tuple[tuple[str, ...], np.ndarray]:
    """std_msgs/Float64MultiArray: names of the components and their values."""
    message = Unpacker(data)
    labels: list[str] = []
    for _ in range(message.unpack("I")):
        labels += message.text().split(",")
        message.unpack("I")
        message.unpack("I")
    message.unpack("I")
    return tuple(labels), message.doubles()


def pack_log(time_ns: int, text: str) -> bytes:
    """rcl_interfaces/Log at level INFO from `lfd`."""
    packer = Packer().stamp(time_ns).pack("B", 20)
    return packer.text("lfd").text(text).text("").text("").pack("I", 0).finish()


def pack_string(text: str) -> bytes:
    """std_msgs/String."""
    return Packer().text(text).finish()


def pack_image(time_ns: int, frame: str, data: bytes) -> bytes:
    """sensor_msgs/CompressedImage of a PNG."""
    return Packer().stamp(time_ns).text(frame).text("png").octets(data).finish()


def unpack_image(data: bytes) -> bytes:
    """sensor_msgs/CompressedImage: the compressed picture."""
    message = Unpacker(data)
    message.stamp()
    message.text()
    message.text()
    return message.octets()
