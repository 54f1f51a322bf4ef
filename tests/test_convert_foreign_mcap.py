"""Recordings of other programs to rows: many clocks by closed forms, and every bad input by its sentence."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lfd.about import about
from lfd.convert.foreign.bags import bags_in, frames_of_mcap
from lfd.convert.foreign.mapping import MapRecipe, map_recipe
from lfd.convert.frames import EpisodeFrames
from lfd.core.errors import RecipeError, RecordingError
from lfd.record.mcap_file import read_mcap
from lfd.record.topic_rates import topic_rates
from tests.foreign_bags import (
    START_NS,
    Stream,
    array,
    header,
    joint_state,
    pose,
    ros,
    stamps,
    write_file,
)

DATA = Path(__file__).parent / "data"
JOINTS = ("shoulder", "elbow")
SPEED = 0.8
"""Of the pose's rotation about z [rad/s]."""


def position(t: np.ndarray) -> np.ndarray:
    """Joint positions [rad]: affine, so that resampling has no error."""
    return np.stack([0.3 + 0.5 * t, 1.0 - 0.25 * t], axis=1)


def turned(t: np.ndarray) -> np.ndarray:
    """Quaternion wxyz of a turn about z at constant speed."""
    half = 0.5 * SPEED * t
    return np.stack([np.cos(half), 0 * t, 0 * t, np.sin(half)], axis=1)


def picture(number: int) -> np.ndarray:
    """A grey picture that tells its number."""
    return np.full((16, 24, 3), 4 * number, np.uint8)


def jpeg(number: int) -> bytes:
    return cv2.imencode(".jpeg", picture(number))[1].tobytes()


RECIPE: dict[str, Any] = {
    "resample": {"fps": 20, "task": "turn the crank", "robot": "ur5e", "max_gap_s": 0.15},
    "map": {
        "arm": {"topic": "/joint_states", "field": "position", "feature": "observation.state", "unit": "rad"},
        "tool": {"topic": "/tool", "field": "pose.orientation", "feature": "observation.state", "unit": "1"},
        "place": {"topic": "/tool", "field": "pose.position", "feature": "observation.state", "unit": "mm"},
        "command": {"topic": "/command", "field": "data", "feature": "action", "unit": "deg"},
        "front": {"topic": "/camera", "feature": "observation.images.front"},
    },
}


def recipe(only: tuple[str, ...] = (), resample: dict[str, Any] | None = None, **entries: dict[str, Any]) -> MapRecipe:
    """The recipe above with some keys changed, and only some entries when they are named."""
    mapped = {name: {**entry, **entries.get(name, {})} for name, entry in RECIPE["map"].items()}
    chosen = {name: entry for name, entry in mapped.items() if not only or name in only}
    return map_recipe({"resample": {**RECIPE["resample"], **(resample or {})}, "map": chosen}, "bag.toml")


def joints_at(t: np.ndarray, frame: str = "") -> Stream:
    """100 Hz joints, received 2 ms after they were measured."""
    rows = position(t)
    messages = [(ns + 2_000_000, joint_state(ns, JOINTS, row, frame)) for ns, row in zip(stamps(t), rows, strict=True)]
    return ros("/joint_states", "sensor_msgs/msg/JointState", messages)


def poses_at(t: np.ndarray, frame: str = "base") -> Stream:
    """Poses in millimetres, each quaternion with a sign of its own."""
    rng = np.random.default_rng(3)
    quats = turned(t) * rng.choice([-1.0, 1.0], len(t))[:, None]
    messages = [
        (ns + 9_000_000, pose(ns, (300 + 100 * s, -50, 8), q, frame))
        for ns, s, q in zip(stamps(t), t, quats, strict=True)
    ]
    return ros("/tool", "geometry_msgs/msg/PoseStamped", messages)


def commands_at(t: np.ndarray) -> Stream:
    """Commands [deg] without a stamp: the log time counts."""
    return ros(
        "/command",
        "std_msgs/msg/Float64MultiArray",
        [(ns, array([10 * k, -10 * k], "shoulder,elbow")) for k, ns in enumerate(stamps(t))],
    )


def camera_at(t: np.ndarray) -> Stream:
    messages = [
        (ns + 30_000_000, {"header": header(ns, "cam"), "format": "jpeg", "data": jpeg(k)})
        for k, ns in enumerate(stamps(t))
    ]
    return ros("/camera", "sensor_msgs/msg/CompressedImage", messages)


COMMAND_TIMES = np.arange(0.02, 2.0, 0.1)
CAMERA_TIMES = np.arange(0.01, 2.0, 1 / 30)
POSE_TIMES = np.arange(0, 2.0, 0.1) + np.random.default_rng(11).uniform(-0.02, 0.02, 20)


@pytest.fixture
def bag(tmp_path: Path) -> Callable[..., Path]:
    """Writes `bag.mcap`: 2 s of joints at 100 Hz, jittered poses at 10 Hz, commands at 10 Hz, pictures at 30 Hz."""

    def write(*streams: Stream, name: str = "bag.mcap", **replaced: Stream) -> Path:
        usual = {
            "joints": joints_at(np.arange(-0.03, 2.0, 0.01)),
            "poses": poses_at(POSE_TIMES),
            "commands": commands_at(COMMAND_TIMES),
            "camera": camera_at(CAMERA_TIMES),
        }
        return write_file(tmp_path / name, *(streams or {**usual, **replaced}.values()))

    return write


def refusal(path: Path, made: MapRecipe) -> str:
    with pytest.raises(RecordingError) as caught:
        frames_of_mcap([path], made)
    text = str(caught.value)
    assert text.startswith(str(path))
    return text


def one(episodes: list[EpisodeFrames]) -> EpisodeFrames:
    assert len(episodes) == 1
    return episodes[0]


def test_many_clocks_become_one(bag: Callable[..., Path]) -> None:
    """Linear, slerp, hold and nearest by the signals' closed forms, in SI units."""
    episode = one(frames_of_mcap([bag()], recipe()))
    begin, end = max(0.02, POSE_TIMES[0]), min(1.92, POSE_TIMES[-1])
    t = begin + np.arange(len(episode)) / 20
    assert t[-1] <= end + 1e-6 < t[-1] + 1 / 20
    state = episode.columns["observation.state"]
    assert state.dtype == np.float32
    assert episode.names["observation.state"] == (
        *("arm.shoulder", "arm.elbow", "tool.w", "tool.x", "tool.y", "tool.z", "place.x", "place.y", "place.z"),
    )
    assert episode.units["observation.state"] == ("rad",) * 2 + ("1",) * 4 + ("m",) * 3
    np.testing.assert_allclose(state[:, :2], position(t), atol=1e-6)
    same = np.abs(np.einsum("td,td->t", state[:, 2:6], turned(t)))
    np.testing.assert_allclose(same, 1.0, atol=1e-6)
    assert (np.einsum("td,td->t", state[1:, 2:6], state[:-1, 2:6]) > 0.9).all()
    np.testing.assert_allclose(state[:, 6:], np.stack([0.3 + 0.1 * t, 0 * t - 0.05, 0 * t + 0.008], axis=1), atol=1e-6)
    held = np.searchsorted(COMMAND_TIMES, t + 1e-6, side="right") - 1
    expected = np.deg2rad(10.0 * np.stack([held, -held], axis=1))
    np.testing.assert_allclose(episode.columns["action"], expected, atol=1e-6)
    assert episode.names["action"] == ("command.shoulder", "command.elbow")
    assert episode.units["action"] == ("rad", "rad")
    nearest = np.abs(CAMERA_TIMES[:, None] - t).argmin(axis=0)
    seen = [int(picture[0, 0, 0]) // 4 for picture in episode.pictures["observation.images.front"]]
    assert seen == nearest.tolist()
    assert (episode.fps, episode.task, episode.about) == (20, "turn the crank", {"robot": "ur5e"})
    told = episode.notes["channels"]
    assert {name: c["method"] for name, c in told.items()} == {
        "arm": "linear", "tool": "slerp", "place": "linear", "command": "hold", "front": "nearest"
    }  # fmt: skip
    assert {c["clock"] for c in told.values()} == {"header", "log"}
    assert told["place"]["longest_interval_s"] < 0.15
    assert episode.notes["gaps"] == []


def test_log_times_on_request(bag: Callable[..., Path]) -> None:
    """Joints are logged 2 ms late, so that on log times they lag behind."""
    only = ("arm", "command")
    episode = one(frames_of_mcap([bag()], recipe(only, {"clock": "log"})))
    t = 0.02 + np.arange(len(episode)) / 20
    np.testing.assert_allclose(episode.columns["observation.state"], position(t - 0.002), atol=1e-6)
    assert episode.notes["channels"]["arm"]["clock"] == "log"


def test_methods_can_be_chosen(bag: Callable[..., Path]) -> None:
    made = recipe(("arm", "command"), arm={"method": "hold", "components": ["elbow"]}, command={"method": "linear"})
    episode = one(frames_of_mcap([bag()], made))
    assert episode.names["observation.state"] == ("arm.elbow",)
    np.testing.assert_allclose(episode.columns["action"][:4, 0], np.deg2rad([0, 5, 10, 15]), atol=1e-6)


# --- gaps ---


def with_hole(times: np.ndarray, begin: float, end: float) -> np.ndarray:
    return times[(times <= begin) | (times >= end)]


HOLED = with_hole(np.arange(0, 2.0, 0.01), 0.805, 1.195)


def test_a_gap_refuses(bag: Callable[..., Path]) -> None:
    text = refusal(bag(joints_at(HOLED), commands_at(COMMAND_TIMES)), recipe(("arm", "command")))
    assert "bag.mcap, topic /joint_states, field position has nothing for 0.400 s from 0.800 s after its first" in text
    assert "(stamp 1757502239.282648699), 0.15 s are allowed; leave the recording out (--skip-bad), set " in text
    assert 'on_gap = "split" in [resample], or allow more with max_gap_s in [map.arm]' in text


def test_a_gap_splits(bag: Callable[..., Path]) -> None:
    path = bag(joints_at(HOLED), commands_at(COMMAND_TIMES))
    first, second = frames_of_mcap([path], recipe(("arm", "command"), {"on_gap": "split"}))
    t = np.arange(0.02, 1.925, 0.05)
    before, after = t[t <= 0.8 + 1e-6], t[t >= 1.2 - 1e-6]
    np.testing.assert_allclose(first.columns["observation.state"], position(before), atol=1e-6)
    np.testing.assert_allclose(second.columns["observation.state"], position(after), atol=1e-6)
    assert first.source == f"{path} from 0.000 s"
    assert second.notes["start_s"] == pytest.approx(after[0] - 0.02)
    (gap,) = second.notes["gaps"]
    assert (gap["channel"], gap["topic"], gap["seconds"], gap["at_s"]) == ("arm", "/joint_states", 0.4, 0.78)
    assert second.notes["dropped"] == []


def test_a_piece_that_is_too_short_is_dropped_and_listed(bag: Callable[..., Path]) -> None:
    path = bag(joints_at(with_hole(HOLED, 1.805, 1.895)), commands_at(COMMAND_TIMES))
    made = recipe(
        ("arm", "command"), {"on_gap": "split", "min_frames": 5, "max_gap_s": 0.09}, command={"max_gap_s": 0.1}
    )
    first, second = frames_of_mcap([path], made)
    assert first.notes["dropped"] == second.notes["dropped"] == [{"at_s": 1.9, "rows": 1}]
    said = refusal(path, recipe(("arm", "command"), {"on_gap": "split", "min_frames": 50}))
    assert "its longest piece without a gap has 16 rows, min_frames is 50" in said


def test_a_longer_gap_may_be_allowed_for_one_channel(bag: Callable[..., Path]) -> None:
    path = bag(joints_at(HOLED), commands_at(COMMAND_TIMES))
    episode = one(frames_of_mcap([path], recipe(("arm", "command"), arm={"max_gap_s": 0.5})))
    np.testing.assert_allclose(
        episode.columns["observation.state"], position(0.02 + np.arange(len(episode)) / 20), atol=1e-6
    )


def test_a_latched_value_stays(bag: Callable[..., Path]) -> None:
    """It neither makes gaps nor ends the episode."""
    path = bag(joints_at(np.arange(0, 2.0, 0.01)), commands_at(np.array([0.1, 0.5])))
    assert "nothing for 0.400 s from 0.000 s" in refusal(path, recipe(("arm", "command")))
    episode = one(frames_of_mcap([path], recipe(("arm", "command"), command={"latched": True})))
    assert len(episode) == 38  # from 0.1 s to 1.99 s
    assert np.unique(episode.columns["action"][:, 0]).size == 2


# --- bad input, each by its sentence ---


def test_missing_topics(bag: Callable[..., Path]) -> None:
    text = refusal(bag(joints_at(np.arange(0, 1, 0.01))), recipe())
    assert (
        "has no messages on topic /tool, which [map.tool] wants; it has /joint_states (sensor_msgs/msg/JointState)"
        in text
    )


def test_clocks_that_jump_back(bag: Callable[..., Path]) -> None:
    t = np.arange(0, 2.0, 0.01)
    late = joints_at(t)
    late.messages = [
        (log, data)
        for (log, _), (_, data) in zip(late.messages, [*late.messages[:50], *late.messages[:150]], strict=True)
    ]
    text = refusal(bag(late), recipe(("arm",)))
    assert "field position: the header clock jumps back by 0.49 s at sample 50, 0.000 s after its first sample" in text
    assert 'clock = "log" in [resample]' in text
    assert one(frames_of_mcap([bag(late)], recipe(("arm",), {"clock": "log"})))


def test_duplicated_stamps(bag: Callable[..., Path]) -> None:
    t = np.arange(0, 2.0, 0.01)
    t[70] = t[69]
    text = refusal(bag(joints_at(t)), recipe(("arm",)))
    assert (
        "samples 69 and 70 have the same header stamp, 0.690 s after its first sample (stamp 1757502239.172648699)"
        in text
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite(bag: Callable[..., Path], bad: float) -> None:
    stream = joints_at(np.arange(0, 1, 0.01))
    broken = ros(
        "/joint_states",
        "sensor_msgs/msg/JointState",
        [(stream.messages[30][0], joint_state(stamps(np.array([0.3]))[0], JOINTS, [0.1, bad]))],
    )
    stream.messages[30] = broken.messages[0]
    text = refusal(bag(stream), recipe(("arm",)))
    assert f"topic /joint_states, field position: elbow is {bad} in sample 30, 0.300 s after its first sample" in text


def test_recordings_without_length(bag: Callable[..., Path], tmp_path: Path) -> None:
    text = refusal(bag(joints_at(np.array([0.0]))), recipe(("arm",)))
    assert (
        "the mapped topics share 0.000 s, from the first sample of /joint_states to the last of /joint_states" in text
    )
    assert "holds no messages; leave it out" in refusal(
        write_file(tmp_path / "empty.mcap", joints_at(np.array([]))), recipe()
    )


def test_a_stamp_of_another_age_does_not_fill_the_memory(bag: Callable[..., Path]) -> None:
    stream = joints_at(np.arange(0, 1, 0.01))
    early = ros("/joint_states", "sensor_msgs/msg/JointState", [(START_NS - 10**9, joint_state(5, JOINTS, [0, 0]))])
    stream.messages = early.messages + stream.messages
    text = refusal(bag(stream), recipe(("arm",), {"on_gap": "split"}))
    assert "1757502238 s between two of /joint_states; leave the recording out" in text
    assert 'set clock = "log"' in text


def test_topics_that_share_no_time(bag: Callable[..., Path]) -> None:
    path = bag(joints_at(np.arange(0, 1, 0.01)), commands_at(np.arange(3, 4, 0.1)))
    text = refusal(path, recipe(("arm", "command")))
    assert "share no time: /command (log clock) begins 2.010 s after /joint_states (header clock) ends" in text


@pytest.mark.parametrize(
    ("name", "changed", "said"),
    [
        (
            "arm",
            {"unit": "N m"},
            "is angle (rad) or length (m) by definition, [map.arm] declares 'N m' (torque); correct unit",
        ),
        ("arm", {"unit": "deg"}, "declared in deg by [map.arm]: no number exceeds 6.283 deg, they look like radians"),
        ("place", {"unit": "m"}, "more than 100 m, it looks like millimetres"),
        ("place", {"unit": "N"}, "is length (m) by definition, [map.place] declares 'N' (force); correct unit"),
        ("command", {"unit": "rad"}, "190 is more than 12.57 rad, it looks like degrees, see 1.900 s after"),
    ],
)
def test_wrong_units(bag: Callable[..., Path], name: str, changed: dict[str, Any], said: str) -> None:
    text = refusal(bag(), recipe(("arm", "place", "command"), **{name: changed}))
    assert said in text
    assert "check_unit = false" in text
    assert one(frames_of_mcap([bag()], recipe(("arm", "place", "command"), **{name: {**changed, "check_unit": False}})))


def test_units_by_the_channels_own_word(bag: Callable[..., Path]) -> None:
    commands = commands_at(COMMAND_TIMES)
    commands.about = {"unit": "rad"}
    text = refusal(bag(commands=commands), recipe())
    assert "has the unit 'rad' by its own word, [map.command] declares 'deg'; correct unit" in text


def test_wrong_frames(bag: Callable[..., Path]) -> None:
    text = refusal(bag(), recipe(("place",), place={"frame": "world"}))
    assert "is in frame 'base' at 0.000 s after its first sample" in text
    assert "[map.place] declares 'world'; correct frame" in text
    assert one(frames_of_mcap([bag()], recipe(("place",), place={"frame": "base"})))
    assert one(frames_of_mcap([bag()], recipe(("arm",), arm={"frame": "base"})))  # the joints name none
    mixed = poses_at(np.arange(0, 1, 0.1))
    mixed.messages[5] = poses_at(np.array([0.5]), "tool").messages[0]
    assert "changes its frame to 'tool' at 0.500 s after its first sample" in refusal(bag(mixed), recipe(("place",)))


def test_pictures_and_numbers_do_not_mix(bag: Callable[..., Path]) -> None:
    path = bag()
    text = refusal(path, recipe(("arm", "front"), front={"feature": "observation.state", "unit": "1"}))
    assert (
        'holds pictures, [map.front] puts them into observation.state; write feature = "observation.images.front"'
        in text
    )
    made = recipe(("arm",), arm={"feature": "observation.images.arm", "unit": "", "field": "position"})
    assert "holds numbers, [map.arm] makes the pictures observation.images.arm of it" in refusal(path, made)


def test_one_channel_under_two_names(bag: Callable[..., Path]) -> None:
    """Where components are names that the recipe gives, only the file shows that they are the same numbers."""
    stream = ros("/command", "std_msgs/msg/Float64MultiArray", [(ns, array([1, 2])) for ns in stamps(COMMAND_TIMES)])
    twice = {name: {**RECIPE["map"]["command"], "components": [f"{name}1", f"{name}2"]} for name in ("a", "b")}
    made = map_recipe({"resample": RECIPE["resample"], "map": twice}, "bag.toml")
    assert "[map.a] and [map.b] both map data; map a channel once" in refusal(bag(stream), made)


def test_angles_that_wrap_round(bag: Callable[..., Path]) -> None:
    t = np.arange(0, 2, 0.1)
    wrapped = (2 + t + np.pi) % (2 * np.pi) - np.pi
    stream = ros(
        "/joint_states",
        "sensor_msgs/msg/JointState",
        [(ns, joint_state(ns, JOINTS, [0.0, x])) for ns, x in zip(stamps(t), wrapped, strict=True)],
    )
    text = refusal(bag(stream), recipe(("arm",)))
    assert "elbow jumps by 6.183 rad before sample 12, 1.200 s after its first sample" in text
    assert one(frames_of_mcap([bag(stream)], recipe(("arm",), arm={"method": "nearest"})))


def test_quaternions_that_are_none(bag: Callable[..., Path]) -> None:
    stream = poses_at(np.arange(0, 1, 0.1))
    stream.messages[4] = ros(
        "/tool",
        "geometry_msgs/msg/PoseStamped",
        [(START_NS + 400_000_000, pose(START_NS + 400_000_000, [0, 0, 0], [0, 0, 0, 0], "base"))],
    ).messages[0]
    assert "the quaternion of sample 4 has length 0 instead of 1, 0.400 s after" in refusal(
        bag(stream), recipe(("tool",))
    )
    made = recipe(("place",), place={"method": "slerp"})
    assert "has the components x, y, z, which are no quaternion" in refusal(bag(), made)


def test_flags_are_held(bag: Callable[..., Path]) -> None:
    grip = ros("/grip", "std_msgs/msg/Bool", [(ns, {"data": k % 2 == 1}) for k, ns in enumerate(stamps(COMMAND_TIMES))])
    entry = {"topic": "/grip", "field": "data", "feature": "closed", "unit": "bool"}
    tables = {"resample": RECIPE["resample"], "map": {"grip": entry}}
    episode = one(frames_of_mcap([bag(grip)], map_recipe(tables, "bag.toml")))
    assert episode.columns["closed"].dtype == bool
    assert episode.columns["closed"][:4, 0].tolist() == [False, False, True, True]
    assert episode.names["closed"] == ("grip.data",)
    entry["method"] = "linear"
    assert 'holds flags; set method = "hold"' in refusal(bag(grip), map_recipe(tables, "bag.toml"))


# --- bags ---


def test_the_files_of_a_bag_are_joined(tmp_path: Path, bag: Callable[..., Path]) -> None:
    t = np.arange(0, 2, 0.01)
    folder = tmp_path / "demo"
    folder.mkdir()
    write_file(folder / "demo_0.mcap", joints_at(t[:100]))
    write_file(folder / "demo_1.mcap", joints_at(t[100:]))
    listed = (
        "rosbag2_bagfile_information:\n  relative_file_paths:\n    - demo_0.mcap\n    - demo_1.mcap\n  duration: 1\n"
    )
    (folder / "metadata.yaml").write_text(listed)
    (bag_files,) = bags_in([tmp_path / "demo"])
    assert [path.name for path in bag_files] == ["demo_0.mcap", "demo_1.mcap"]
    episode = one(frames_of_mcap(bag_files, recipe(("arm",))))
    assert episode.source == str(folder)
    assert len(episode) == 40
    whole = bag(joints_at(t))
    expected = one(frames_of_mcap([whole], recipe(("arm",)))).columns["observation.state"]
    assert np.array_equal(episode.columns["observation.state"], expected)
    assert bags_in([tmp_path]) == [(whole,), bag_files]
    (folder / "demo_1.mcap").unlink()
    with pytest.raises(RecordingError, match=r"demo_1.mcap is missing, which metadata.yaml names"):
        bags_in([folder])


def test_files_of_two_bags_are_not_one(tmp_path: Path) -> None:
    a = write_file(tmp_path / "a.mcap", joints_at(np.arange(0, 1, 0.01)))
    other = ros("/joint_states", "std_msgs/msg/Float64", [(START_NS + 2 * 10**9, {"data": 1.0})])
    b = write_file(tmp_path / "b.mcap", other)
    with pytest.raises(RecordingError, match=r"b.mcap, topic /joint_states holds std_msgs/msg/Float64"):
        frames_of_mcap([a, b], recipe(("arm",)))


@pytest.mark.parametrize("name", ["old.db3", "old.bag"])
def test_bags_of_other_kinds_say_how_to_convert_them(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    for source in (tmp_path / name, tmp_path):
        with pytest.raises(RecordingError, match="ros2 bag convert" if name.endswith("db3") else "rosbags-convert"):
            bags_in([source])
    (tmp_path / "metadata.yaml").write_text("a:\n  relative_file_paths:\n    - old.db3\n")
    with pytest.raises(RecordingError, match="is a bag in SQLite"):
        bags_in([tmp_path])


# --- real files ---


def test_a_real_bag() -> None:
    """15 joint states at about 9.5 Hz, on the stamps of their headers, among 31 other channels."""
    tables = {
        "resample": {"fps": 10, "task": "wave", "robot": "arm", "max_gap_s": 0.2},
        "map": {
            "arm": {
                "topic": "/joint_state",
                "field": "position",
                "components": ["shoulder_joint", "elbow_joint", "wrist_joint"],
                "feature": "observation.state",
                "unit": "rad",
                "frame": "base_link",
            },
            "gripper": {
                "topic": "/joint_state",
                "field": "position",
                "components": ["gripper_joint"],
                "feature": "action",
                "unit": "rad",
            },
        },
    }
    path = DATA / "rerun_rosbag2_all_sensor_msgs.mcap"
    episode = one(frames_of_mcap([path], map_recipe(tables, "bag.toml")))
    assert len(episode) == 15
    np.testing.assert_allclose(episode.columns["observation.state"][0], [0.0, 1.3, -0.2], atol=1e-6)
    t = np.arange(15) / 10
    np.testing.assert_allclose(episode.columns["observation.state"][:, 0], 0.5 * np.sin(t), atol=0.02)
    np.testing.assert_allclose(np.unique(episode.columns["action"]), [0.0, 0.1], atol=1e-6)


def test_real_pictures() -> None:
    """One raw and one compressed picture: no episode, but they decode."""
    from lfd.convert.foreign.mapping import MapEntry
    from lfd.convert.foreign.message_samples import samples_of_topic

    content = read_mcap(DATA / "rerun_rosbag2_all_sensor_msgs.mcap")
    for topic, shape in (("/image", (480, 640, 3)), ("/compressed_image", (480, 640, 3))):
        entry = MapEntry(topic=topic, feature="observation.images.front")
        samples = samples_of_topic(content.topics[topic], content.messages[topic], topic, entry, "header")
        assert samples.pictures is not None
        assert samples.pictures[0].shape == shape
        assert samples.frames == {"base_link": 0}


def test_a_real_bag_of_one_message() -> None:
    tables = {
        "resample": {"fps": 10, "task": "wave", "robot": "arm", "max_gap_s": 0.2},
        "map": {"a": {"topic": "/one_shot/joint_state", "field": "position", "feature": "action", "unit": "rad"}},
    }
    text = refusal(DATA / "rosbag2parquet_joint_state_imu.mcap", map_recipe(tables, "bag.toml"))
    assert "share 0.000 s" in text
    tables["map"]["a"] |= {"topic": "/one_shot/twist", "field": "linear", "unit": "m/s"}
    assert "share 0.000 s" in refusal(DATA / "rosbag2parquet_base_msgs.mcap", map_recipe(tables, "bag.toml"))
    tables["map"]["a"] |= {"topic": "/one_shot/string", "field": "data"}
    assert "it is text, no number" in refusal(DATA / "rosbag2parquet_base_msgs.mcap", map_recipe(tables, "bag.toml"))


def test_a_real_channel_that_cannot_be_decoded() -> None:
    entry = {"topic": "/add_two_ints/_service_event", "field": "request[0].a", "feature": "action", "unit": "1"}
    tables = {"resample": RECIPE["resample"], "map": {"a": entry}}
    text = refusal(DATA / "rosbag2_topics_and_services.mcap", map_recipe(tables, "bag.toml"))
    assert "topic /add_two_ints/_service_event" in text
    assert "AddTwoInts_Event" in text


@pytest.mark.parametrize("path", sorted(DATA.glob("*.mcap")), ids=lambda path: path.stem)
def test_info_of_any_file(path: Path) -> None:
    facts = about(path)
    assert facts["kind"] == "recording"
    assert any(key.startswith("topic ") for key in facts)
    assert any(key.startswith("metadata rosbag2") for key in facts)


def test_info_tells_rates_and_gaps(bag: Callable[..., Path]) -> None:
    path = bag(joints_at(HOLED), commands_at(COMMAND_TIMES))
    rates = {rate.topic: rate for rate in topic_rates(read_mcap(path))}
    joints = rates["/joint_states"]
    assert (joints.messages, joints.gaps) == (len(HOLED), 1)
    assert (joints.longest_s, joints.longest_at_s) == pytest.approx((0.4, 0.8))
    facts = about(path)
    assert facts["topic /joint_states"] == (
        "sensor_msgs/msg/JointState, 161 messages, 80.4 Hz, 1 gap, the longest of 0.400 s at 0.800 s"
    )
    assert facts["topic /command"] == "std_msgs/msg/Float64MultiArray, 20 messages, 10.0 Hz, no gaps"


def test_a_log_clock_that_jumps_back(bag: Callable[..., Path]) -> None:
    commands = commands_at(COMMAND_TIMES)
    (first, data), (second, other) = commands.messages[4:6]
    commands.messages[4:6] = [(second, data), (first, other)]
    text = refusal(bag(joints_at(np.arange(0, 2, 0.01)), commands), recipe(("arm", "command")))
    assert "topic /command: the log clock jumps back by 0.1 s at log time" in text


def test_a_task_that_the_recording_says(bag: Callable[..., Path]) -> None:
    told = ros("/task", "std_msgs/msg/String", [(START_NS, {"data": "stir the soup"})])
    path, asked = bag(joints_at(np.arange(0, 1, 0.01)), told), {"task": "", "task_topic": "/task"}
    assert one(frames_of_mcap([path], recipe(("arm",), asked))).task == "stir the soup"
    silent = bag(joints_at(np.arange(0, 1, 0.01)))
    assert "no messages on topic /task, which [resample] task_topic names" in refusal(silent, recipe(("arm",), asked))
    text = refusal(path, recipe(("arm",), {**asked, "task_topic": "/joint_states"}))
    assert "topic /joint_states holds no text in its field data" in text
    for wrong in ({"task": ""}, {"task_topic": "/task"}):
        with pytest.raises(RecipeError, match="needs task, the instruction in words, or task_topic"):
            recipe(("arm",), wrong)
