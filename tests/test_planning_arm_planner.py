from dataclasses import replace
from functools import cache
from time import thread_time
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from lfd.core.errors import InputError, UnknownName
from lfd.planning.arm_model import load_arm
from lfd.planning.arm_planner import GOAL_TOLERANCE_M, STIFFNESS, ArmPlanner
from lfd.planning.kinematics import GRIPPER, forward
from lfd.planning.scenes import cup_scene
from lfd.planning.signed_distances import Box, table_of
from lfd.planning.trajectory_costs import TrajectoryCost, rest_to_rest

FEATURES = ("table_distance", "person_closeness", "laptop_closeness", "cup_tilt", "joint_speed")
WEIGHTS = np.array([-1.0, -1.0, -1.0, -2.0, -0.1])
SETTING: dict[str, Any] = {"features": FEATURES, "waypoints": 20, "duration_s": 4.0, "smoothness": 0.05}


@cache
def planner(robot: str = "panda", *, free_goal: bool = False) -> ArmPlanner:
    arm = load_arm(robot)
    return ArmPlanner(arm, cup_scene(arm), **SETTING, free_goal=free_goal)


@pytest.mark.parametrize("robot", ["panda", "ur5e", "sawyer", "iiwa", "kinova3", "jaco"])
def test_a_plan_keeps_its_ends_and_limits_and_beats_the_straight_way(robot: str, rng: np.random.Generator) -> None:
    planning = planner(robot)
    plan = planning.plan(WEIGHTS, rng=rng)
    arm, scene = planning.arm, planning.scene
    assert plan.converged
    assert not plan.collides
    assert plan.clearance > 0
    assert plan.trajectory.shape == (20, arm.joints)
    np.testing.assert_array_equal(plan.trajectory[[0, -1]], [scene.start, scene.goal])
    assert ((arm.low <= plan.trajectory) & (plan.trajectory <= arm.high)).all()
    np.testing.assert_allclose(plan.features, planning.features(plan.trajectory[None])[0])
    assert plan.reward == pytest.approx(WEIGHTS @ plan.features)
    assert plan.reward > WEIGHTS @ planning.features(planning.straight()[None])[0] + 0.3


def test_scipy_finds_nothing_better_nearby(rng: np.random.Generator) -> None:
    planning = planner()
    plan = planning.plan(WEIGHTS, rng=rng)
    cost = TrajectoryCost(
        planning.arm,
        planning.scene.places,
        planning.features_used,
        WEIGHTS,
        dt_s=planning.dt_s,
        smoothness=SETTING["smoothness"] * rest_to_rest(20, planning.dt_s),
        shapes=table_of(planning.scene.shapes),
        margin_m=0.03,
        stiffness=STIFFNESS * float(np.linalg.norm(WEIGHTS)),
    )

    def inner(flat: np.ndarray) -> tuple[float, np.ndarray]:
        whole = plan.trajectory[None].copy()
        whole[0, 1:-1] = flat.reshape(18, -1)
        value, gradient = cost(whole, np.array([0]))
        return value[0], gradient[0, 1:-1].ravel()

    start = plan.trajectory[1:-1].ravel()
    bounds = list(zip(np.tile(planning.arm.low, 18), np.tile(planning.arm.high, 18), strict=True))
    better = minimize(
        inner, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 3000, "ftol": 1e-12}
    )
    assert inner(start)[0] - better.fun < 1e-3


def test_eight_starts_come_near_to_sixty_four(rng: np.random.Generator) -> None:
    excess = []
    for _ in range(5):
        weights = -rng.exponential(1.0, 5) * np.array([1, 1, 1, 1, 0.1])
        few, many = (planner().plan(weights, starts=starts, rng=rng).cost for starts in (8, 64))
        excess.append((few - many) / many)
    assert np.median(excess) < 0.01  # now and then the best valley is missed


def test_more_weight_on_a_feature_never_makes_it_larger(rng: np.random.Generator) -> None:
    """Of optima: (w' - w) . (f' - f) >= 0; the weights of closenesses grow more negative here."""
    for feature in (1, 2):
        counts = []
        for weight in (-0.1, -0.5, -2.0):
            weights = WEIGHTS.copy()
            weights[feature] = weight
            counts.append(planner().plan(weights, starts=16, rng=rng).features[feature])
        assert counts[0] > counts[1] - 1e-3 > counts[2] - 2e-3


def test_a_warm_start_takes_less_and_is_quick(rng: np.random.Generator) -> None:
    cold = planner().plan(WEIGHTS, starts=1)
    nearby = WEIGHTS * np.array([1.05, 1.0, 0.95, 1.0, 1.1])
    again, seconds = [], []
    for _ in range(5):
        began = thread_time()
        again.append(planner().plan(nearby, warm=cold.trajectory, starts=1))
        seconds.append(thread_time() - began)
    assert again[0].evaluations < cold.evaluations / 2
    assert again[0].cost <= planner().plan(nearby, starts=1).cost + 1e-3
    assert np.median(seconds) < 0.15


def test_feature_counts_do_not_depend_on_the_number_of_waypoints() -> None:
    arm = load_arm("panda")
    scene, names = cup_scene(arm), (*FEATURES, "joint_effort", "path_length", "joint_jerk")
    counts = []
    for waypoints in (20, 200):
        planning = ArmPlanner(arm, scene, features=names, waypoints=waypoints, duration_s=4.0, smoothness=1.0)
        part = np.linspace(0.0, 1.0, waypoints)
        ease = part**3 * (10 - 15 * part + 6 * part**2)
        swing = np.sin(2 * np.pi * ease)[:, None] * np.array([0.0, 0.3, 0.0, 0.2, 0.0, 0.2, 0.0])
        counts.append(planning.features((scene.start + ease[:, None] * (scene.goal - scene.start) + swing)[None])[0])
    np.testing.assert_allclose(counts[0][:-1], counts[1][:-1], rtol=0.03)
    assert counts[0][-1] == pytest.approx(counts[1][-1], rel=0.2)  # of a third difference, dt^2 counts for more


def test_a_free_goal_is_reached_and_is_not_worse_than_a_posture(rng: np.random.Generator) -> None:
    fixed = planner().plan(WEIGHTS, rng=rng)
    planning = planner(free_goal=True)
    free = planning.plan(WEIGHTS, warm=fixed.trajectory, starts=1)
    assert free.converged
    assert 0 < free.goal_error <= GOAL_TOLERANCE_M
    gripper = forward(planning.arm, free.trajectory[-1:]).points[0, GRIPPER]
    np.testing.assert_allclose(gripper, planning.scene.places.goal, atol=1.01e-3)
    assert free.cost < fixed.cost


def test_a_plan_through_a_wall_says_so(rng: np.random.Generator) -> None:
    whole = load_arm("panda")
    scene = cup_scene(whole)
    ends = np.stack([scene.start, scene.goal])
    arm = replace(whole, low=ends.min(axis=0) - 0.1, high=ends.max(axis=0) + 0.1)  # it cannot go around
    walled = replace(scene, shapes=(*scene.shapes, Box((0.35, 0.0, 1.0), (0.6, 0.01, 1.0))))
    plan = ArmPlanner(arm, walled, **SETTING).plan(WEIGHTS, starts=2, rng=rng)
    assert plan.collides
    assert plan.clearance < 0
    assert not plan.converged


def test_an_obstacle_on_the_straight_way_is_passed(rng: np.random.Generator) -> None:
    arm = load_arm("panda")
    scene = cup_scene(arm)
    post = replace(scene, shapes=(*scene.shapes, Box((-0.08, 0.0, 0.9), (0.03, 0.03, 0.15))))
    planning = ArmPlanner(arm, post, **SETTING)
    assert planning.clearance(planning.straight()[None])[0] < 0
    plan = planning.plan(np.array([0.0, 0.0, 0.0, -1.0, -0.1]), rng=rng)
    assert plan.converged
    assert plan.clearance > 0


def test_the_same_generator_gives_the_same_plan() -> None:
    plans = [planner().plan(WEIGHTS, rng=np.random.default_rng(3)) for _ in range(2)]
    np.testing.assert_array_equal(plans[0].trajectory, plans[1].trajectory)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"waypoints": 3}, "at least 4 waypoints"),
        ({"duration_s": 0.0}, "positive time"),
        ({"smoothness": np.nan}, "positive time and smoothness"),
    ],
)
def test_settings_that_make_no_plan_are_refused(changes: dict, sentence: str) -> None:
    arm = load_arm("panda")
    with pytest.raises(InputError, match=sentence):
        ArmPlanner(arm, cup_scene(arm), **(SETTING | changes))


def test_scenes_that_do_not_fit_are_refused() -> None:
    arm = load_arm("panda")
    scene = cup_scene(arm)
    with pytest.raises(InputError, match=r"the scene's start has \(6,\) joints, 'panda' has 7"):
        ArmPlanner(arm, replace(scene, start=scene.start[:6], goal=scene.goal[:6]), **SETTING)
    with pytest.raises(InputError, match="beyond the joint limits"):
        ArmPlanner(arm, replace(scene, goal=scene.goal + 9.0), **SETTING)
    with pytest.raises(InputError, match="in the scene's start the arm is .* inside a shape"):
        ArmPlanner(arm, replace(scene, shapes=(Box((-0.08, -0.3, 1.0), (0.1, 0.1, 0.1)),)), **SETTING)
    with pytest.raises(UnknownName, match="unknown arm feature"):
        ArmPlanner(arm, scene, features=("speed",), waypoints=20, duration_s=4.0, smoothness=0.05)


def test_requests_that_do_not_fit_are_refused() -> None:
    planning = planner()
    with pytest.raises(InputError, match="give one finite number for each of table_distance"):
        planning.plan(np.ones(3), starts=1)
    with pytest.raises(InputError, match="an rng for more than one"):
        planning.plan(WEIGHTS)
    with pytest.raises(InputError, match=r"give one of shape \(20, 7\)"):
        planning.plan(WEIGHTS, warm=np.zeros((10, 7)), starts=1)
