import numpy as np
import pytest

from lfd import make_world
from lfd.experts.pick_place_can import BIN_CENTRE, BIN_HALF, GRASPS, PickPlaceCanExpert
from lfd.experts.style import ExpertStyle
from lfd.run.wilson import wilson_interval
from tests.expert_trials import Meddled, check_same_action, once, pushed, put, successes


@pytest.fixture(scope="module")
def world():
    return make_world("PickPlaceCan", "panda", 20)


@pytest.mark.slow
def test_it_succeeds_from_at_least_98_percent_of_200_starts(world) -> None:
    solved = successes(world, PickPlaceCanExpert(world.spec), 41, 200)
    assert solved >= 196, wilson_interval(solved, 200)


@pytest.mark.slow
@pytest.mark.parametrize("at", [15, 40, 75])
def test_it_recovers_from_random_actions(world, at) -> None:
    assert successes(world, Meddled(PickPlaceCanExpert(world.spec), pushed(world, at)), 42, 10, 400) >= 9


@pytest.mark.slow
@pytest.mark.parametrize("at", [15, 40, 75])
@pytest.mark.parametrize("place", [(0.0, -0.35, 0.86), (0.1, -0.05, 0.86), (0.25, -0.2, 0.86)])
def test_it_recovers_from_a_can_put_elsewhere(world, at, place) -> None:
    """Also by a wall, nearer than it ever starts."""
    policy = Meddled(PickPlaceCanExpert(world.spec), once(at, lambda _: put(world, "Can_joint0", place)))
    assert successes(world, policy, 42, 5, 400) >= 4


@pytest.mark.slow
def test_a_can_that_has_fallen_over_is_picked_up_across(world) -> None:
    lying = np.array([1.0, np.cos(0.4), np.sin(0.4), 0.0]) / np.sqrt(2)
    fallen = once(5, lambda _: put(world, "Can_joint0", [0.05, -0.25, 0.85], lying))
    assert successes(world, Meddled(PickPlaceCanExpert(world.spec), fallen), 42, 10, 400) >= 9


@pytest.mark.slow
def test_every_grasp_and_speed_succeeds(world) -> None:
    expert = PickPlaceCanExpert(world.spec, ExpertStyle(speed=(0.6, 1.0), approach="any"))
    assert successes(world, expert, 44, 30, 400) >= 29


def test_the_same_observation_gives_the_same_action(world) -> None:
    check_same_action(world, lambda: PickPlaceCanExpert(world.spec), 30)


@pytest.mark.parametrize("grasp", range(len(GRASPS)))
def test_open_fingers_keep_clear_of_the_walls(world, grasp) -> None:
    """Brute force: the outer corners of both open fingers, wherever the can stands in the bin."""
    expert = PickPlaceCanExpert(world.spec)
    expert._grasp = GRASPS[grasp]
    upright, rng = np.array([1.0, 0.0, 0.0, 0.0]), np.random.default_rng(5)
    for _ in range(500):
        can = np.array([*(BIN_CENTRE + rng.uniform(-1, 1, 2) * (BIN_HALF - 0.0355)), 0.86])
        yaw = expert._yaw(can, upright)
        along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        corners = np.array([can[:2] + u * 0.047 * along + v * 0.008 * across for u in (-1, 1) for v in (-1, 1)])
        assert (np.abs(corners - BIN_CENTRE) < BIN_HALF + 0.002).all()


def test_the_fingers_close_across_a_can_that_lies(world) -> None:
    expert = PickPlaceCanExpert(world.spec)
    for angle in np.linspace(-3, 3, 13):
        quat = np.array([1.0, np.cos(angle), np.sin(angle), 0.0]) / np.sqrt(2)  # a quarter turn about a level axis
        axis = angle - np.pi / 2
        yaw = expert._yaw(np.array([0.1, -0.25, 0.845]), quat)
        assert np.cos(yaw - axis) == pytest.approx(0.0, abs=1e-9)
