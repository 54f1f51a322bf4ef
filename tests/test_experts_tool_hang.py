import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfd import make_world
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.noise import NoisyPolicy
from lfd.experts.reaching import Hand
from lfd.experts.style import ExpertStyle
from lfd.experts.tool_hang import (
    BOTTOM_M,
    FRAME_GRIP,
    MOUNT,
    R_FRAME_HAND,
    R_TOOL_HAND,
    TURN_RAD,
    Pose,
    ToolHangExpert,
    about_hook,
    beside_segment,
    placing,
    slowly,
)
from lfd.run.wilson import wilson_interval
from tests.expert_trials import Meddled, check_same_action, once, pushed, put, successes

HORIZON = 800


@pytest.fixture(scope="module")
def world():
    return make_world("ToolHang", "panda", 20)


def shift(world, name: str, by) -> None:
    """Move a free object that lies on the table aside."""
    was = world._data.joint(f"{name}_joint0").qpos
    put(world, f"{name}_joint0", was[:3] + by, was[3:])


@pytest.mark.slow
def test_the_tool_is_hung_from_at_least_95_percent_of_60_starts(world) -> None:
    solved = successes(world, ToolHangExpert(world.spec), 41, 60, HORIZON)
    assert solved >= 57, wilson_interval(solved, 60)


@pytest.mark.slow
@pytest.mark.parametrize(("at", "name", "by"), [(20, "frame", [-0.03, 0.02, 0.0]), (150, "tool", [0.04, -0.03, 0.0])])
def test_it_recovers_from_things_put_elsewhere(world, at, name, by) -> None:
    policy = Meddled(ToolHangExpert(world.spec), once(at, lambda _: shift(world, name, by)))
    assert successes(world, policy, 42, 10, HORIZON) >= 8


@pytest.mark.slow
@pytest.mark.parametrize("at", [10, 60, 140])
def test_it_recovers_from_random_actions(world, at) -> None:
    """While it reaches, while it carries the frame, and on its way to the tool."""
    assert successes(world, Meddled(ToolHangExpert(world.spec), pushed(world, at)), 42, 10, HORIZON) >= 7


@pytest.mark.slow
def test_every_speed_and_grasp_succeeds_under_noise(world) -> None:
    expert = ToolHangExpert(world.spec, ExpertStyle(speed=(0.6, 1.0), approach="any"))
    assert successes(world, NoisyPolicy(expert, world.spec.labels["action"], scale=0.05), 44, 15, HORIZON) >= 12


def test_the_same_observation_gives_the_same_action(world) -> None:
    check_same_action(world, lambda: ToolHangExpert(world.spec), 150)


def test_grips_mount_and_ring_are_where_the_expert_takes_them_to_be(world) -> None:
    seen = world.reset(np.random.default_rng(2))
    at = {name: world._data.geom(name).xpos for name in ("frame_grip_frame", "stand_base", "tool_grip_g0")}
    walls = np.array([world._data.geom(f"stand_wall{i}").xpos for i in range(4)])
    top = seen["stand_pos"] + matrix_from_wxyz(seen["stand_quat"]) @ MOUNT
    np.testing.assert_allclose(
        seen["frame_pos"] + matrix_from_wxyz(seen["frame_quat"]) @ FRAME_GRIP, at["frame_grip_frame"]
    )
    np.testing.assert_allclose(seen["tool_pos"], at["tool_grip_g0"])
    np.testing.assert_allclose(top[:2], walls[:, :2].mean(axis=0), atol=1e-9)
    tall = world._model.geom("stand_wall0").size[2]
    assert top[2] == pytest.approx(walls[0, 2] + tall)
    floor = at["stand_base"][2] + world._model.geom("stand_base").size[2]
    assert top[2] - BOTTOM_M == pytest.approx(floor, abs=0.0015)


def test_the_hands_that_hold_are_rotations() -> None:
    for rotation in (R_FRAME_HAND, R_TOOL_HAND):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)


def test_slowly_turns_no_further_than_it_may_and_arrives(rng) -> None:
    for _ in range(50):
        rotation, goal = Rotation.random(rng=rng), Rotation.random(rng=rng).as_matrix()
        for _ in range(13):
            following = Rotation.from_matrix(slowly(rotation.as_matrix(), goal))
            assert (following * rotation.inv()).magnitude() <= TURN_RAD + 1e-9
            rotation = following
        np.testing.assert_allclose(rotation.as_matrix(), goal, atol=1e-9)


def test_following_the_moves_brings_what_is_held_to_its_goal(rng) -> None:
    """T_world_held = T_world_hand T_hand_held, with the second factor fixed."""
    for _ in range(20):
        hand = Hand(rng.uniform(-1, 1, 3), Rotation.random(rng=rng).as_matrix())
        place, turn = rng.uniform(-0.2, 0.2, 3), Rotation.random(rng=rng).as_matrix()
        goal = Pose(rng.uniform(-1, 1, 3), Rotation.random(rng=rng).as_matrix())
        for _ in range(14):
            move = placing(hand, Pose(hand.position + hand.rotation @ place, hand.rotation @ turn), goal)
            hand = Hand(move.position, move.rotation)
        np.testing.assert_allclose(hand.position + hand.rotation @ place, goal.position, atol=1e-9)
        np.testing.assert_allclose(hand.rotation @ turn, goal.rotation, atol=1e-9)


def test_the_distance_from_a_segment_is_that_from_its_nearest_point(rng) -> None:
    for _ in range(50):
        point, begin, end = rng.uniform(-1, 1, (3, 2))
        points = begin + np.linspace(0, 1, 2001)[:, None] * (end - begin)
        assert beside_segment(point, begin, end) == pytest.approx(
            np.linalg.norm(points - point, axis=1).min(), abs=1e-3
        )


def test_the_hook_sees_a_ring_by_its_place_and_the_tool_s_tilt(rng) -> None:
    for tilt in (0.0, 0.7, 1.5):
        frame = Pose(rng.uniform(-1, 1, 3), Rotation.random(rng=rng).as_matrix())
        hook, place = rng.uniform(-1, 1, 3), rng.uniform(-0.1, 0.1, 3)
        handle = frame.rotation @ [-np.sin(tilt), 0.0, -np.cos(tilt)]
        across = frame.rotation[:, 1]
        ring = Pose(hook + frame.rotation @ place, np.column_stack([handle, across, np.cross(handle, across)]))
        seen = about_hook(ring, hook, frame)
        np.testing.assert_allclose([seen.inward, seen.aside, seen.height, seen.tilt], [*place, tilt], atol=1e-9)
