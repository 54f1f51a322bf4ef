import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning.arm_model import load_arm
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.kinematics import GRIPPER, forward
from lfd.planning.replanning import Rest
from lfd.planning.scenes import cup_scene

WEIGHTS = np.array([-0.5, -0.3])


@pytest.fixture(scope="module")
def planner() -> ArmPlanner:
    arm = load_arm("panda")
    return ArmPlanner(
        arm,
        cup_scene(arm),
        features=("laptop_closeness", "table_distance"),
        waypoints=12,
        duration_s=10.0,
        smoothness=1.0,
    )


def test_the_first_waypoints_stay_where_they_are_told_to(planner) -> None:
    warm = planner.straight()
    warm[1] += 0.01
    plan = planner.plan(WEIGHTS, warm=warm, fixed=2, starts=1)
    np.testing.assert_array_equal(plan.trajectory[:2], warm[:2])
    np.testing.assert_array_equal(plan.trajectory[-1], planner.scene.goal)
    free = planner.plan(WEIGHTS, warm=warm, starts=1)
    assert not np.allclose(free.trajectory[1], warm[1])
    assert free.cost < plan.cost


@pytest.mark.parametrize("fixed", [0, 11])
def test_too_many_fixed_waypoints_are_refused(planner, fixed) -> None:
    with pytest.raises(InputError, match="of 12 waypoints 1 to 10"):
        planner.plan(WEIGHTS, warm=planner.straight(), fixed=fixed, starts=1)


def test_the_rest_of_a_plan_from_its_own_state_is_the_rest_of_the_plan(planner) -> None:
    """Bellman's principle, as far as velocities at a waypoint are told by the one before it."""
    whole = planner.plan(WEIGHTS, starts=1)
    rest = Rest(planner, 10.0 - 4 * whole.dt_s)
    assert (rest.count, rest.dt_s) == (8, pytest.approx(whole.dt_s))
    velocity = (whole.trajectory[4] - whole.trajectory[3]) / whole.dt_s
    found = rest.replan(WEIGHTS, position=whole.trajectory[4], velocity=velocity, warm=whole.trajectory[4:])
    assert found is not None
    np.testing.assert_allclose(found.trajectory, whole.trajectory[4:], atol=5e-3)


def test_an_arm_that_was_pushed_aside_plans_on_from_there(planner) -> None:
    whole = planner.plan(WEIGHTS, starts=1)
    rest = Rest(planner, 6.0)
    aside = planner.straight()[5] + np.array([0.1, -0.1, 0.05, 0.0, 0.0, 0.1, 0.0])
    velocity = np.full(7, 0.05)
    warm = np.linspace(aside, planner.scene.goal, rest.count)
    found = rest.replan(WEIGHTS, position=aside, velocity=velocity, warm=warm)
    assert found is not None
    np.testing.assert_array_equal(found.trajectory[0], aside)
    np.testing.assert_array_equal(found.trajectory[-1], planner.scene.goal)
    np.testing.assert_allclose(found.features, rest.features(found.trajectory[None])[0])
    assert found.reward == pytest.approx(WEIGHTS @ found.features)
    assert found.clearance >= 0
    assert whole.features.shape == found.features.shape
    first = (found.trajectory[1] - found.trajectory[0]) / rest.dt_s
    still = rest.replan(WEIGHTS, position=aside, velocity=np.zeros(7), warm=warm)
    assert still is not None
    faster = first - (still.trajectory[1] - still.trajectory[0]) / rest.dt_s
    assert (faster > 0).all()
    assert faster.mean() > 0.01


def test_there_is_no_way_on_from_within_the_table(planner) -> None:
    low = planner.straight()[5].copy()
    for _ in range(40):  # forward in the shoulder, until the cup is in the table
        low[1] += 0.05
        if forward(planner.arm, low[None]).points[0, GRIPPER, 2] < 0.8:
            break
    warm = np.linspace(low, planner.scene.goal, 9)
    assert Rest(planner, 7.0).replan(WEIGHTS, position=low, velocity=np.zeros(7), warm=warm) is None
