from dataclasses import replace

import numpy as np
import pytest

from lfd import make_world
from lfd.experts.grippers import gripper_of
from lfd.experts.reaching import Hand, pointing_down, side_yaw
from lfd.experts.stack import GRASPS, RADIUS_B_M, StackExpert
from lfd.experts.style import ExpertStyle
from lfd.run.wilson import wilson_interval
from tests.expert_trials import Meddled, check_same_action, once, pushed, put, successes


@pytest.fixture(scope="module")
def world():
    return make_world("Stack", "panda", 20)


@pytest.mark.slow
def test_stack_succeeds_from_at_least_98_percent_of_200_starts(world) -> None:
    solved = successes(world, StackExpert(world.spec), 41, 200)
    assert solved >= 196, wilson_interval(solved, 200)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "least", "horizon"),
    [("ur5e", 19, 300), ("iiwa", 19, 300), ("kinova3", 19, 300), ("sawyer", 19, 300), ("jaco", 15, 500)],
)
def test_the_same_expert_stacks_with_every_arm(robot, least, horizon) -> None:
    world = make_world("Stack", robot, 20)
    assert successes(world, StackExpert(world.spec), 43, 20, horizon) >= least


@pytest.mark.slow
@pytest.mark.parametrize("at", [10, 25, 40])
def test_it_recovers_from_random_actions(world, at) -> None:
    assert successes(world, Meddled(StackExpert(world.spec), pushed(world, at)), 42, 15) >= 14


@pytest.mark.slow
@pytest.mark.parametrize("at", [15, 30, 45])
def test_it_recovers_from_a_cube_put_elsewhere(world, at) -> None:
    policy = Meddled(StackExpert(world.spec), once(at, lambda _: put(world, "cubeA_joint0", [0.09, -0.12, 0.82])))
    assert successes(world, policy, 42, 15) >= 14
    policy = Meddled(StackExpert(world.spec), once(at, lambda _: put(world, "cubeB_joint0", [-0.09, 0.13, 0.825])))
    assert successes(world, policy, 42, 15) >= 14


@pytest.mark.slow
def test_every_grasp_and_speed_stacks(world) -> None:
    expert = StackExpert(world.spec, ExpertStyle(speed=(0.6, 1.0), approach="any"))
    assert successes(world, expert, 44, 30) >= 29


def test_the_same_observation_gives_the_same_action(world) -> None:
    check_same_action(world, lambda: StackExpert(world.spec), 30)


@pytest.mark.parametrize("robot", ["panda", "ur5e", "iiwa"])
def test_open_fingers_keep_clear_of_cube_b_and_turn_no_further_than_they_must(world, robot) -> None:
    """Brute force: points of both open fingers against B as a disc, at every distance that a start may have."""
    spec = replace(world.spec, robot=robot)
    gripper, rng, turned = gripper_of(spec), np.random.default_rng(3), 0
    hand = Hand(np.zeros(3), pointing_down(np.pi / 2))
    x, y = np.meshgrid(
        np.linspace(-gripper.reach_m, gripper.reach_m, 61), np.linspace(-gripper.breadth_m, gripper.breadth_m, 9)
    )
    for grasp in GRASPS:
        expert = StackExpert(spec)
        expert._grasp = grasp
        for _ in range(200):
            distance, way = rng.uniform(0.064, 0.25), rng.uniform(-np.pi, np.pi)
            b = np.array([distance * np.cos(way), distance * np.sin(way), 0.825])

            def clearance(yaw: float, b=b) -> float:
                points = x[..., None] * [np.cos(yaw), np.sin(yaw)] + y[..., None] * [-np.sin(yaw), np.cos(yaw)]
                return float(np.linalg.norm(points - b[:2], axis=-1).min()) - RADIUS_B_M

            yaw = expert._yaw(hand, np.array([0.0, 0.0, 0.82]), b, np.array([1.0, 0.0, 0.0, 0.0]))
            assert clearance(yaw) > -0.001
            turned += yaw != grasp
            if distance < gripper.reach_m + RADIUS_B_M - 0.011 and yaw != grasp:
                assert clearance(yaw) == pytest.approx(0.003, abs=0.002)
    assert 0 < turned < 400


def test_the_yaw_of_a_side_is_that_of_the_box_whichever_face_it_lies_on(rng) -> None:
    for _ in range(50):
        yaw = rng.uniform(-np.pi, np.pi)
        turned = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        face = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)
        face[0] *= np.linalg.det(face)
        assert np.sin(2 * (side_yaw(turned @ face) - yaw)) == pytest.approx(0.0, abs=1e-9)
