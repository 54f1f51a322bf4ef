"""Messages of other programs: what they say, in every encoding, and the sentence for those that say nothing."""

import base64
import contextlib
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lfd.convert.foreign.field_path import parse_field
from lfd.convert.foreign.mapping import MapEntry
from lfd.convert.foreign.message_decoding import decode_message, decoder_of
from lfd.convert.foreign.message_fields import frame_of, numbers_at, stamp_of
from lfd.convert.foreign.message_samples import samples_of_topic
from lfd.convert.foreign.samples import Samples
from lfd.core.errors import RecordingError
from lfd.record import cdr
from lfd.record.mcap_file import Topic
from tests.foreign_bags import (
    START_NS,
    Stream,
    array,
    as_json,
    header,
    joint_state,
    pose,
    protobuf_class,
    ros,
)

WHERE = "bag.mcap, topic /t"
PICTURE = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3) * 3


def topic_of(stream: Stream) -> Topic:
    return Topic(stream.encoding, stream.schema, stream.schema_encoding, stream.definition, stream.about)


def samples_of(stream: Stream, clock: str = "header", **entry: Any) -> Samples:
    given_entry = MapEntry(topic=stream.topic, **{"feature": "observation.state", "unit": "1", **entry})
    return samples_of_topic(topic_of(stream), stream.messages, WHERE, given_entry, clock)


def pictures_of(stream: Stream) -> Samples:
    return samples_of(stream, feature="observation.images.front", unit="")


def refusal(stream: Stream, **entry: Any) -> str:
    with pytest.raises(RecordingError) as caught:
        list(samples_of(stream, **entry).pictures or ())
    return str(caught.value)


def test_joint_state_by_name_and_in_the_order_asked_for() -> None:
    """Messages may list joints in any order, and another publisher's joints may come on the same topic."""
    stream = ros(
        "/t",
        "sensor_msgs/msg/JointState",
        [
            (5, joint_state(100, ["a", "b", "c"], [1, 2, 3])),
            (6, joint_state(200, ["finger"], [9])),
            (7, joint_state(300, ["c", "a", "b"], [30, 10, 20])),
        ],
    )
    samples = samples_of(stream, field="position", components=("c", "a"))
    assert samples.names == ("c", "a")
    assert samples.values is not None
    assert samples.values.tolist() == [[3, 1], [30, 10]]
    assert samples.times_ns.tolist() == [100, 300]
    assert samples.dimensions == ("angle", "length")
    assert samples_of(stream, "log", field="position", components=("finger",)).times_ns.tolist() == [6]
    assert "has none of the components wrist; it has c, a, b" in refusal(
        stream, field="position", components=("wrist",)
    )
    said = refusal(stream, field="position")
    assert "field position changes on the way: 3 numbers (a, b, c) at log time 0.000000005, 1 numbers (finger)" in said
    assert "pick components by name, or leave the recording out" in said


def test_empty_fields_are_named() -> None:
    stream = ros("/t", "sensor_msgs/msg/JointState", [(5, joint_state(100, ["a"], [1]))])
    assert "field effort is empty in message 0 at log time 0.000000005" in refusal(stream, field="effort")


def test_poses_come_with_the_scalar_first() -> None:
    stream = ros("/t", "geometry_msgs/msg/PoseStamped", [(5, pose(START_NS, [1, 2, 3], [0.5, 0.1, 0.2, 0.3], "base"))])
    orientation = samples_of(stream, field="pose.orientation")
    assert orientation.names == ("w", "x", "y", "z")
    assert orientation.values is not None
    assert orientation.values.tolist() == [[0.5, 0.1, 0.2, 0.3]]
    assert orientation.frames == {"base": 0}
    assert orientation.times_ns.tolist() == [START_NS]
    position = samples_of(stream, field="pose.position")
    assert position.names == ("x", "y", "z")
    assert "it has the fields position, orientation; add one of them" in refusal(stream, field="pose")
    assert "no field 'pos' in pose; it has position, orientation" in refusal(stream, field="pose.pos")
    assert "it is text, no number" in refusal(stream, field="header.frame_id")


def test_the_fast_encoder_and_ours_agree() -> None:
    """Our own packing is read by the same path as ROS 2's."""
    ours = ros("/t", "geometry_msgs/msg/PoseStamped", [(5, cdr.pack_pose(7, np.arange(3.0), np.array([0.0, 0, 0, 1])))])
    assert samples_of(ours, field="pose.orientation").values == pytest.approx(np.array([[1.0, 0, 0, 0]]))


def test_arrays_with_and_without_labels() -> None:
    labelled = ros("/t", "std_msgs/msg/Float64MultiArray", [(5, array([1, 2, 3], "a,b,c"))], unit="rad")
    assert samples_of(labelled, field="data").names == ("a", "b", "c")
    assert samples_of(labelled, field="data[1:]").names == ("b", "c")
    assert samples_of(labelled, field="data[2]").names == ("c",)
    assert samples_of(labelled, field="data").unit == "rad"
    assert samples_of(labelled, field="data").clock == "log"
    plain = ros("/t", "std_msgs/msg/Float64MultiArray", [(5, array([1, 2, 3]))])
    assert samples_of(plain, field="data[0:2]").names == ()
    assert "data has 3 elements, element 6 was asked for" in refusal(plain, field="data[0:7]")
    assert "data has 3 elements, element 3 was asked for" in refusal(plain, field="data[3]")


def test_action_sizes_that_change() -> None:
    stream = ros(
        "/t", "std_msgs/msg/Float64MultiArray", [(5, array([1, 2])), (6, array([1, 2])), (7, array([1, 2, 3]))]
    )
    said = refusal(stream, field="data", feature="action")
    assert "bag.mcap, topic /t, field data changes on the way: 2 numbers at log time 0.000000005" in said
    assert "3 numbers in message 2 at 0.000000007" in said


def test_twists_scalars_and_flags() -> None:
    twist = {"linear": {"x": 1.0, "y": 2.0, "z": 3.0}, "angular": {"x": 4.0, "y": 5.0, "z": 6.0}}
    plain = samples_of(ros("/t", "geometry_msgs/msg/Twist", [(5, twist)]), field="angular")
    assert plain.values is not None
    assert plain.values.tolist() == [[4, 5, 6]]
    assert plain.dimensions == ("angular velocity",)
    stamped = ros("/t", "geometry_msgs/msg/TwistStamped", [(5, {"header": header(9, "/tool"), "twist": twist})])
    assert samples_of(stamped, field="twist.linear").frames == {"tool": 0}
    flag = samples_of(ros("/t", "std_msgs/msg/Bool", [(5, {"data": True})]), field="data")
    assert flag.values is not None
    assert flag.values.dtype == bool
    number = samples_of(ros("/t", "std_msgs/msg/Float64", [(5, {"data": 0.25})]), field="data")
    assert number.values is not None
    assert number.values.tolist() == [[0.25]]
    whole = ros("/t", "std_msgs/msg/Int32MultiArray", [(5, array([]) | {"data": [1, 2]})])
    assert samples_of(whole, field="data").values == pytest.approx(np.array([[1.0, 2.0]]))


def test_the_log_time_serves_where_a_stamp_is_zero() -> None:
    stream = ros("/t", "sensor_msgs/msg/JointState", [(5, joint_state(0, ["a"], [1])), (6, joint_state(0, ["a"], [1]))])
    samples = samples_of(stream, field="position")
    assert samples.times_ns.tolist() == [5, 6]
    assert samples.clock == "log"


IMAGE = {"height": 4, "width": 6, "is_bigendian": 0}


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", PICTURE),
        ("bgr8", PICTURE[..., ::-1]),
        ("rgba8", np.dstack([PICTURE, np.full((4, 6), 255, np.uint8)])),
        ("bgra8", np.dstack([PICTURE[..., ::-1], np.full((4, 6), 255, np.uint8)])),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_pictures_with_and_without_padding(encoding: str, pixels: np.ndarray, padding: int) -> None:
    rows = np.hstack([pixels.reshape(4, -1), np.full((4, padding), 77, np.uint8)])
    message = {"header": header(9), **IMAGE, "encoding": encoding, "step": rows.shape[1], "data": rows.tobytes()}
    samples = pictures_of(ros("/t", "sensor_msgs/msg/Image", [(5, message)]))
    assert samples.pictures is not None
    assert np.array_equal(samples.pictures[0], PICTURE)
    assert samples.times_ns.tolist() == [9]


def test_grey_pictures() -> None:
    grey = PICTURE[..., 0]
    message = {"header": header(9), **IMAGE, "encoding": "mono8", "step": 6, "data": grey.tobytes()}
    samples = pictures_of(ros("/t", "sensor_msgs/msg/Image", [(5, message)]))
    assert samples.pictures is not None
    assert np.array_equal(samples.pictures[0], np.dstack([grey] * 3))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"encoding": "mono16"}, "is encoded as 'mono16'; lfd reads rgb8, bgr8, rgba8, bgra8, mono8"),
        ({"data": b"\0" * 17}, "a picture of 6 x 4 rgb8 with a step of 18 does not fit 17 bytes"),
        ({"step": 6}, "with a step of 6 does not fit"),
        ({"height": 0}, "a picture of 6 x 0"),
        ({"height": 2**31, "step": 18}, "does not fit 72 bytes"),
    ],
)
def test_raw_pictures_that_are_none(changed: dict[str, Any], said: str) -> None:
    message = {"header": header(9_000_000_001), **IMAGE, "encoding": "rgb8", "step": 18, "data": PICTURE.tobytes()}
    stream = ros("/t", "sensor_msgs/msg/Image", [(5, message | changed)])
    text = refusal(stream, feature="observation.images.front", unit="")
    assert text.startswith("bag.mcap, topic /t, message with stamp 9.000000001: ")
    assert said in text


def compressed(kind: str, picture: np.ndarray = PICTURE) -> bytes:
    return cv2.imencode(f".{kind}", picture[..., ::-1])[1].tobytes()


def compressed_stream(*pictures: bytes, told: str = "jpeg") -> Stream:
    messages = [(k, {"header": header(k + 9), "format": told, "data": data}) for k, data in enumerate(pictures)]
    return ros("/t", "sensor_msgs/msg/CompressedImage", messages)


def test_compressed_pictures() -> None:
    samples = pictures_of(compressed_stream(compressed("png")))
    assert samples.pictures is not None
    assert np.array_equal(samples.pictures[0], PICTURE)
    smooth = np.dstack([np.add.outer(np.arange(64), np.arange(96))] * 3).astype(np.uint8)
    samples = pictures_of(compressed_stream(compressed("jpeg", smooth), told="rgb8; jpeg compressed bgr8"))
    assert samples.pictures is not None
    assert np.abs(samples.pictures[0].astype(int) - smooth).mean() < 2


def test_compressed_pictures_that_are_none() -> None:
    pictures = {"feature": "observation.images.front", "unit": ""}
    assert "lfd reads PNG and JPEG" in refusal(compressed_stream(b"webp", told="webp"), **pictures)
    assert "the JPEG ends too soon" in refusal(compressed_stream(compressed("jpeg")[:-40]), **pictures)
    assert "cannot be decoded" in refusal(compressed_stream(compressed("png")[:60], told="png"), **pictures)
    deep = cv2.imencode(".png", np.zeros((4, 6), np.uint16))[1].tobytes()
    assert "16 bits a colour; lfd reads 8" in refusal(compressed_stream(deep, told="png"), **pictures)
    other = compressed("png", PICTURE[:2])
    said = refusal(compressed_stream(compressed("png"), other), **pictures)
    assert "message with stamp 0.000000010: a picture of 6 x 2, the first has 6 x 4" in said


def test_json_messages() -> None:
    data = base64.b64encode(compressed("png")).decode()
    stream = as_json(
        "/t",
        "foxglove.CompressedImage",
        [(5, {"timestamp": {"sec": 1, "nsec": 5}, "frame_id": "cam", "format": "png", "data": data})],
    )
    samples = pictures_of(stream)
    assert samples.pictures is not None
    assert np.array_equal(samples.pictures[0], PICTURE)
    assert samples.times_ns.tolist() == [1_000_000_005]
    assert samples.frames == {"cam": 0}
    poses = as_json(
        "/t",
        "foxglove.PoseInFrame",
        [
            (
                5,
                {
                    "timestamp": {"sec": 1, "nsec": 5},
                    "frame_id": "base",
                    "pose": {
                        "position": {"x": 1, "y": 2, "z": 3},
                        "orientation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8},
                    },
                },
            )
        ],
    )
    orientation = samples_of(poses, field="pose.orientation")
    assert orientation.values is not None
    assert orientation.values.tolist() == [[0.8, 0, 0, 0.6]]
    assert orientation.dimensions == ("ratio",)
    own = as_json("/t", "", [(5, {"joints": [1, 2.5], "name": ["a", "b"], "note": "x", "nothing": None})])
    assert samples_of(own, field="joints").names == ("a", "b")
    assert "it is null, no number" in refusal(own, field="nothing")
    assert "no field 'grip' in the message; it has joints, name, note, nothing" in refusal(own, field="grip")


@pytest.mark.parametrize("time", [{"sec": "1", "nsec": 0}, {"sec": None, "nsec": 0}, 7, "now", [1]])
def test_stamps_of_no_known_form_count_as_none(time: Any) -> None:
    stream = as_json("/t", "", [(5, {"timestamp": time, "x": 1})])
    assert samples_of(stream, field="x").clock == "log"


def test_strange_json() -> None:
    far = as_json("/t", "", [(5, {"timestamp": {"sec": 10**12, "nsec": 0}, "x": 1})])
    assert "message 0 at log time 0.000000005 has the time 1000000000000000000000 ns, which is no date" in refusal(
        far, field="x"
    )
    huge = as_json("/t", "", [(5, {"x": [10**400], "layout": 3, "y": [1]})])
    assert "message 0 at log time 0.000000005" in refusal(huge, field="x")
    assert "message 0 at log time 0.000000005" in refusal(huge, field="y")


def test_json_that_is_none() -> None:
    broken = Stream("/t", "x", "json", "jsonschema", b"{}", [(5, b'{"a": 1')])
    assert "cannot be decoded at log time 0.000000005 (JSONDecodeError" in refusal(broken, field="a")


def test_protobuf_messages() -> None:
    kind, definition = protobuf_class("arm", "State", {"q": "repeated double", "grip": "double", "note": "string"})
    stream = Stream("/t", "arm.State", "protobuf", "protobuf", definition)
    stream.messages = [
        (5, kind(q=[1.0, 2.0], grip=0.5).SerializeToString()),
        (6, kind(q=[3.0, 4.0]).SerializeToString()),
    ]
    samples = samples_of(stream, field="q")
    assert samples.values is not None
    assert samples.values.tolist() == [[1, 2], [3, 4]]
    grip = samples_of(stream, field="grip")
    assert grip.values is not None
    assert grip.values.tolist() == [[0.5], [0.0]]  # protobuf writes no zeros
    assert "no field 'x' in the message; it has q, grip, note" in refusal(stream, field="x")
    stream.messages.append((7, b"\x0a\xff\xff\xff\xff\x0f"))
    assert "bag.mcap, topic /t cannot be decoded at log time 0.000000007 (DecodeError" in refusal(stream, field="q")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"encoding": "ros1"}, "is sensor_msgs/msg/JointState in ros1, its definition in ros2msg; lfd reads ROS 2 CDR"),
        (
            {"schema_encoding": "ros2idl"},
            "its definition in ros2idl; lfd reads ROS 2 CDR with its definition as ros2msg",
        ),
        ({"schema": "", "schema_encoding": ""}, "is no type in cdr, its definition in none"),
        ({"definition": b"float64[ position"}, "has a definition of sensor_msgs/msg/JointState that cannot be read"),
        ({"definition": b"geometry_msgs/Nowhere position"}, "cannot be decoded at log time 0.000000005"),
        ({"encoding": "protobuf", "schema_encoding": "protobuf"}, "has a definition of"),
        ({"encoding": ""}, "in no known encoding"),
    ],
)
def test_unknown_schemas(changed: dict[str, Any], said: str) -> None:
    stream = ros("/t", "sensor_msgs/msg/JointState", [(5, joint_state(1, ["a"], [1]))])
    for name, value in changed.items():
        setattr(stream, name, value)
    text = refusal(stream, field="position")
    assert text.startswith(WHERE)
    assert said in text


def test_big_endian_and_other_encapsulations() -> None:
    big = struct.pack(">HH d", 0x0000, 0, 2.5)
    decoder = decoder_of(topic_of(ros("/t", "std_msgs/msg/Float64", [])), WHERE)
    assert decode_message(decoder, big, WHERE, 0).data == 2.5
    xcdr2 = b"\x00\x07\x00\x00" + big[4:]
    with pytest.raises(RecordingError, match="encapsulation 0007, expected 0001 or 0000"):
        decode_message(decoder, xcdr2, WHERE, 0)


@given(st.data())
def test_damaged_messages_are_recording_errors(data: st.DataObject) -> None:
    """Cut or changed bytes give numbers or a sentence, never another error."""
    names = ["shoulder", "elbow", "wrist"]
    stream = ros("/t", "sensor_msgs/msg/JointState", [(5, joint_state(1, names, [1, 2, 3]))])
    whole = stream.messages[0][1]
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 3))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    stream.messages = [(5, bytes(damaged))]
    with contextlib.suppress(RecordingError):
        samples = samples_of(stream, field="position")
        assert samples.values is not None
        assert len(samples.values) == 1


def test_stamp_and_frame_of_a_message_without() -> None:
    decoder = decoder_of(topic_of(as_json("/t", "", [])), WHERE)
    message = decode_message(decoder, b'{"x": [[1, 2], [3, 4]], "timestamp": 7}', WHERE, 0)
    assert stamp_of(message, decoder) == 0
    assert frame_of(message, decoder) == ""
    assert numbers_at(message, decoder, parse_field("x[1]", "here"))[0].tolist() == [3, 4]


def test_the_foxglove_sdk(tmp_path: Path) -> None:
    """What Foxglove's own writer makes: protobuf with descriptors, zstd chunks of unknown size."""
    import foxglove
    from foxglove.channels import PoseInFrameChannel, RawImageChannel
    from foxglove.messages import Pose, PoseInFrame, Quaternion, RawImage, Timestamp, Vector3

    from lfd.record.mcap_file import read_mcap

    path = tmp_path / "foxglove.mcap"
    with foxglove.open_mcap(path):
        poses, pictures = PoseInFrameChannel("/pose"), RawImageChannel("/raw")
        for k in range(3):
            there = Pose(position=Vector3(x=float(k), y=0.0, z=0.0), orientation=Quaternion(x=0.0, y=0.0, z=0.6, w=0.8))
            poses.log(PoseInFrame(timestamp=Timestamp(100 + k, 5), frame_id="base", pose=there), log_time=10**18 + k)
        raw = RawImage(
            timestamp=Timestamp(100),
            frame_id="cam",
            width=6,
            height=4,
            encoding="rgb8",
            step=18,
            data=PICTURE.tobytes(),
        )
        pictures.log(raw, log_time=10**18)
    content = read_mcap(path)
    entry = MapEntry(topic="/pose", field="pose.orientation", feature="observation.state", unit="1")
    seen = samples_of_topic(content.topics["/pose"], content.messages["/pose"], WHERE, entry, "header")
    assert seen.values is not None
    assert seen.values.tolist() == [[0.8, 0, 0, 0.6]] * 3
    assert seen.times_ns.tolist() == [(100 + k) * 10**9 + 5 for k in range(3)]
    assert seen.frames == {"base": 0}
    entry = MapEntry(topic="/raw", feature="observation.images.front")
    camera = samples_of_topic(content.topics["/raw"], content.messages["/raw"], WHERE, entry, "header")
    assert camera.pictures is not None
    assert np.array_equal(camera.pictures[0], PICTURE)
