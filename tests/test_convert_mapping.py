"""The recipe of a mapping: what it may say, and the sentence for what it may not."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lfd.convert.foreign.field_path import meet, members_of, parse_field
from lfd.convert.foreign.mapping import TABLES, map_recipe
from lfd.convert.foreign.units import UNITS, defined_dimensions, suspicion
from lfd.core.errors import InputError
from lfd.core.recipe import load_toml

RECIPE = """
[resample]
fps = 30
task = "lift the cube"
robot = "ur5e"
max_gap_s = 0.2

[map.arm]
topic = "/joint_states"
field = "position"
components = ["j1", "j2"]
feature = "observation.state"
unit = "deg"

[map.command]
topic = "/command"
field = "data"
feature = "action"
unit = "controller"
latched = true

[map.front]
topic = "/camera"
feature = "observation.images.front"
"""


def read(text: str):
    return map_recipe(tomllib.loads(text), "bag.toml")


def refusal(text: str) -> str:
    with pytest.raises(InputError) as caught:
        read(text)
    return str(caught.value)


def test_a_recipe_as_it_should_be() -> None:
    recipe = read(RECIPE)
    assert list(recipe.entries) == ["arm", "command", "front"]
    assert recipe.resample.clock == "header"
    assert recipe.resample.on_gap == "refuse"
    assert recipe.max_gap_s("arm") == 0.2
    assert recipe.max_gap_s("command") == float("inf")
    assert recipe.entries["front"].is_picture


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("fps = 30", "fps = 0", "fps = 0: expected at least 1"),
        ("fps = 30", "fps = 30\nrate = 3", "unknown key in bag.toml [resample]: 'rate'; known: clock, fps, max_gap_s"),
        ("fps = 30\n", "", "bag.toml [resample] lacks fps: Rows a second of the dataset [Hz]."),
        ("fps = 30", 'fps = 30\nclock = "mine"', "unknown clock in bag.toml [resample]: 'mine'; known: header, log"),
        ("fps = 30", 'fps = 30\non_gap = "fill"', "known: refuse, split"),
        ("max_gap_s = 0.2", "max_gap_s = 0", "expected seconds above 0"),
        ("max_gap_s = 0.2", "max_gap_s = inf", "expected seconds above 0"),
        ("latched = true", "max_gap_s = inf", "expected seconds above 0"),
        ("latched = true", 'latched = true\nmethod = "linear"', "a latched value is held; leave out one of the two"),
        ('robot = "ur5e"', 'robot = " "', "robot is empty"),
        ('unit = "deg"', 'unit = "furlong"', "unknown unit in bag.toml [map.arm]: 'furlong'; known: "),
        ('unit = "deg"', "", "bag.toml [map.arm] lacks unit: say in which unit the source has it, such as rad, "),
        ('unit = "deg"', 'unit = "deg"\nmethod = "spline"', "known: hold, linear, nearest, slerp"),
        ('unit = "deg"', 'unit = "deg"\nmethod = "slerp"', "with the components w, x, y and z, not j1, j2; use linear"),
        ('field = "position"', 'field = "position.."', "is no path; write it like pose.position"),
        ('field = "position"', 'field = "a[0:2].b"', "is no path"),
        ('["j1", "j2"]', '["j1", "j1"]', "a name is listed twice: j1, j1"),
        ('"observation.state"', '"timestamp"', "cannot be a feature; write observation.state"),
        ('"observation.images.front"', '"observation.images."', "cannot be a feature"),
        (
            '"observation.images.front"',
            '"observation.images.front"\nmethod = "linear"',
            "known: hold, nearest",
        ),
        ('"observation.images.front"', '"observation.images.front"\nunit = "m"', "pictures have no unit; leave it out"),
        ('"/command"', '""', "topic is empty; `lfd info RECORDING` lists the topics"),
    ],
)
def test_what_a_recipe_may_not_say(old: str, new: str, said: str) -> None:
    assert old in RECIPE
    assert said in refusal(RECIPE.replace(old, new, 1))


def test_tables_that_are_missing() -> None:
    assert "bag.toml has no [resample] table" in refusal("[map.a]\ntopic = 'x'")
    assert "bag.toml has no [map.NAME] table" in refusal(RECIPE.split("[map.arm]")[0])
    assert "'topic' is no table; write it as [map.topic]" in refusal(
        RECIPE.split("[map.arm]")[0] + "[map]\ntopic = 'x'"
    )


def double(first: str, second: str) -> str:
    head = RECIPE.split("[map.arm]")[0]
    return head + f"[map.a]\n{first}\n[map.b]\n{second}\n"


ARM = 'topic = "/j"\nfield = "position"\nunit = "rad"\nfeature = "observation.state"\n'


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (ARM, ARM.replace("observation.state", "action")),
        (ARM, ARM + 'components = ["j1"]'),
        (ARM + 'components = ["j1", "j2"]', ARM + 'components = ["j2"]'),
        (ARM.replace("position", "position[0:3]"), ARM.replace("position", "position[2]")),
        (ARM.replace("position", "pose"), ARM.replace("position", "pose.position")),
        (ARM.replace("position", ""), ARM.replace("position", "x")),
    ],
)
def test_a_channel_mapped_twice(first: str, second: str) -> None:
    assert "[map.a] and [map.b] both map /j" in refusal(double(first, second))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (ARM + 'components = ["j1"]', ARM + 'components = ["j2"]'),
        (ARM.replace("position", "position[0:3]"), ARM.replace("position", "position[3:]")),
        (ARM, ARM.replace("position", "velocity").replace('"rad"', '"rad/s"')),
        (ARM, ARM.replace("/j", "/k")),
    ],
)
def test_parts_of_a_channel_may_stand_apart(first: str, second: str) -> None:
    assert list(read(double(first, second)).entries) == ["a", "b"]


def test_two_cameras_in_one_feature() -> None:
    front = 'topic = "/a"\nfeature = "observation.images.front"'
    assert "both make observation.images.front" in refusal(double(front, front.replace("/a", "/b")))


def test_one_name_twice_is_said_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "twice.toml"
    path.write_text(RECIPE + '\n[map.arm]\ntopic = "/x"\n')
    with pytest.raises(InputError, match=r"twice.toml is no TOML: Cannot declare \('map', 'arm'\) twice \(at line 26"):
        load_toml(path, TABLES)


def test_paths() -> None:
    assert parse_field("", "here") == ()
    assert parse_field("poses[1].pose.position", "here") == ("poses", 1, "pose", "position")
    assert parse_field("data[2:]", "here") == ("data", slice(2, None))
    assert members_of(parse_field("poses[1].position", "here")) == "poses.position"


@given(st.integers(0, 9), st.integers(1, 9), st.integers(0, 9), st.integers(1, 9))
def test_parts_of_arrays_meet_when_they_share_an_element(a: int, m: int, b: int, n: int) -> None:
    shared = bool(set(range(a, a + m)) & set(range(b, b + n)))
    assert meet(("data", slice(a, a + m)), ("data", slice(b, b + n))) == shared
    assert not meet(("data", slice(a, a + m)), ("date", slice(a, a + m)))


def test_units_by_definition() -> None:
    assert defined_dimensions("sensor_msgs/msg/JointState", "position") == ("angle", "length")
    assert defined_dimensions("geometry_msgs/msg/PoseStamped", "pose.position.x") == ("length",)
    assert defined_dimensions("geometry_msgs/msg/PoseStamped", "pose.orientation") == ("ratio",)
    assert defined_dimensions("geometry_msgs/msg/Twist", "angular") == ("angular velocity",)
    assert defined_dimensions("foxglove.PoseInFrame", "pose.position") == ("length",)
    assert defined_dimensions("nav_msgs/msg/Odometry", "twist.twist.linear.x") == ("velocity",)
    assert defined_dimensions("geometry_msgs/msg/Point", "") == ("length",)
    assert defined_dimensions("std_msgs/msg/Float64MultiArray", "data") == ()


def test_every_unit_has_one_size_per_dimension() -> None:
    assert np.isclose(180 * UNITS["deg"].factor, np.pi)
    assert np.isclose(60 * UNITS["rpm"].factor, 2 * np.pi)
    assert np.isclose(36 * UNITS["km/h"].factor, 10)
    for unit in UNITS.values():
        assert UNITS[unit.si].factor == 1.0
        assert UNITS[unit.si].dimension == unit.dimension


def test_sizes_that_cannot_be() -> None:
    assert suspicion(np.array([[0.0, 1.0], [2.0, -90.0]]), "rad", absolute=False) == (
        1,
        "90 is more than 12.57 rad, it looks like degrees",
        "deg",
    )
    assert suspicion(np.array([[0.5], [-1.5]]), "deg", absolute=True) == (
        1,
        "no number exceeds 6.283 deg, they look like radians",
        "rad",
    )
    assert suspicion(np.array([[450.0]]), "m", absolute=False) is not None
    assert suspicion(np.array([[0.4]]), "mm", absolute=True) is not None
    assert suspicion(np.array([[0.4]]), "mm", absolute=False) is None
    for values, unit in (([[3.0]], "rad"), ([[0.0]], "deg"), ([[40.0]], "deg"), ([[0.8]], "m"), ([[1e9]], "1")):
        assert suspicion(np.array(values), unit, absolute=True) is None
