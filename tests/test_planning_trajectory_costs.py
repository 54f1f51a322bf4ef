from dataclasses import replace

import numpy as np
import pytest

from lfd.planning.arm_model import load_arm
from lfd.planning.scenes import cup_scene
from lfd.planning.signed_distances import table_of
from lfd.planning.trajectory_costs import TrajectoryCost, jerk_squares, rest_to_rest, step_squares
from lfd.rewards.arm_features import ARM_FEATURES, arm_features

NAMES = list(ARM_FEATURES)
WAYPOINTS, DT_S = 9, 0.3
STEP = 1e-6


def cost_of(
    weights: np.ndarray, *, smoothness: float = 0.0, stiffness: float = 0.0, margin: float = 0.03
) -> TrajectoryCost:
    arm = load_arm("panda")
    scene = cup_scene(arm)
    person, laptop = scene.places.person, scene.places.laptop
    wide = replace(scene.places, obstacle=laptop, person=replace(person, radius=1.5))  # so that all features vary
    return TrajectoryCost(
        arm,
        wide,
        arm_features(NAMES),
        weights,
        dt_s=DT_S,
        smoothness=smoothness * rest_to_rest(WAYPOINTS, DT_S),
        shapes=table_of(scene.shapes),
        margin_m=margin,
        stiffness=stiffness,
    )


def trajectories(rng: np.random.Generator) -> np.ndarray:
    arm = load_arm("panda")
    scene = cup_scene(arm)
    line = np.linspace(scene.start, scene.goal, WAYPOINTS)
    return np.clip(line + 0.3 * rng.standard_normal((3, WAYPOINTS, arm.joints)), arm.low, arm.high)


def check_gradient(cost: TrajectoryCost, x: np.ndarray, rng: np.random.Generator) -> None:
    rows = np.arange(len(x))
    _, gradient = cost(x, rows)
    for _ in range(4):
        aside = rng.standard_normal(x.shape)
        more, less = (cost(x + sign * STEP * aside, rows)[0] for sign in (1, -1))
        along = np.einsum("btd,btd->b", gradient, aside)
        np.testing.assert_allclose(along, (more - less) / (2 * STEP), rtol=1e-6, atol=1e-7 * np.abs(gradient).sum())


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_of_each_feature(name: str, rng: np.random.Generator) -> None:
    x = trajectories(rng)
    cost = cost_of(-1.0 * (np.array(NAMES) == name))
    assert np.ptp(cost(x, np.arange(len(x)))[0]) > 0
    check_gradient(cost, x, rng)


def test_the_gradient_of_everything_together(rng: np.random.Generator) -> None:
    x = trajectories(rng)
    cost = cost_of(
        rng.standard_normal(len(NAMES)) * np.where(np.array(NAMES) == "joint_jerk", 1e-3, 1.0),
        smoothness=0.1,
        stiffness=100.0,
        margin=0.3,
    )
    cost.multipliers, cost.goal_stiffness = rng.standard_normal((len(x), 3)), 7.0
    check_gradient(cost, x, rng)


def test_quadratic_forms_are_the_sums_they_stand_for(rng: np.random.Generator) -> None:
    q = rng.standard_normal(WAYPOINTS)
    speed = np.diff(q) / DT_S
    bend = np.diff(speed, prepend=0.0, append=0.0) / DT_S
    assert q @ rest_to_rest(WAYPOINTS, DT_S) @ q == pytest.approx(DT_S * (bend**2).sum())
    assert q @ step_squares(WAYPOINTS, DT_S) @ q == pytest.approx(DT_S * (speed**2).sum())
    jerk = np.diff(q, n=3) / DT_S**3
    assert q @ jerk_squares(WAYPOINTS, DT_S) @ q == pytest.approx(DT_S * (jerk**2).sum())
