import numpy as np
import pytest

from lfd.core.channels import CHANNELS, channel, observed
from lfd.core.errors import RecipeError, UnknownName


def test_objects_are_filled_in() -> None:
    row = channel("cube_pos")
    assert (row.name, row.topic, row.path) == ("cube_pos", "/objects/cube/pose", "plots/objects/cube/position")
    assert channel("round_nut_quat").topic == "/objects/round_nut/pose"


def test_names_of_channels_that_end_like_objects_are_not_objects() -> None:
    assert channel("joint_pos") is CHANNELS["joint_pos"]
    assert channel("ee_quat") is CHANNELS["ee_quat"]


def test_each_kind_of_channel_with_a_blank_is_found_by_its_ending() -> None:
    assert channel("left_ee_pos").topic == "/left_ee_pose"
    assert channel("robot1_ee_quat").feature == "observation.state"
    assert channel("Door_qpos").topic == "/objects/Door/joints"
    assert channel("handle_point").path == "plots/objects/handle/point"


def test_a_difference_is_a_channel_of_its_own() -> None:
    row = channel("cube_pos - ee_pos")
    assert (row.name, row.unit, row.feature) == ("cube_pos - ee_pos", "m", "observation.environment_state")
    seen = {"cube_pos": np.array([1.0, 2.0, 3.0]), "ee_pos": np.array([0.5, 0.0, 4.0])}
    np.testing.assert_array_equal(observed(seen, "cube_pos - ee_pos"), [0.5, 2.0, -1.0])
    assert observed(seen, "ee_pos") is seen["ee_pos"]
    with pytest.raises(
        RecipeError, match=r"no difference of two channels .* cube_pos \[m, world\], ee_quat \[1, world\]"
    ):
        channel("cube_pos - ee_quat")
    with pytest.raises(UnknownName, match="unknown channel 'hand'"):
        channel("cube_pos - hand")


def test_unknown_channel_lists_the_known() -> None:
    with pytest.raises(UnknownName, match=r"unknown channel 'joint_poz'; known: .*joint_pos.*Did you mean 'joint_pos'"):
        channel("joint_poz")


def test_lerobot_keys_follow_its_rule_of_names() -> None:
    """LeRobot makes every key that starts with `action` an output and with `observation` an input."""
    for row in CHANNELS.values():
        feature = row.feature or ""
        assert feature.startswith("action") == (feature == "action")
        inputs = ("observation.state", "observation.environment_state", "observation.images.{camera}")
        assert feature.startswith("observation") == (feature in inputs)
