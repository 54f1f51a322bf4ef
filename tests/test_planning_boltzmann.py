from dataclasses import replace

import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning import ArmPlanner, cup_scene, load_arm
from lfd.planning.boltzmann import Demonstrator, boltzmann_points
from lfd.planning.signed_distances import Floor
from lfd.planning.trajectory_costs import rest_to_rest, step_squares

FEATURES = ("person_closeness", "cup_tilt", "joint_speed")


def planner(*, clear: bool) -> ArmPlanner:
    arm = load_arm("panda")
    scene = cup_scene(arm)
    scene = replace(scene, shapes=(Floor(-5.0),)) if clear else scene
    return ArmPlanner(arm, scene, features=FEATURES, waypoints=8, duration_s=10.0, smoothness=2.0)


def test_a_quadratic_cost_gives_the_gaussian_of_its_curvature(rng: np.random.Generator) -> None:
    root = rng.normal(size=(3, 3))
    curvature, middle = root @ root.T + np.eye(3), np.array([1.0, -2.0, 0.5])
    found = boltzmann_points(
        lambda x: 7.0 + 0.5 * np.einsum("bi,ij,bj->b", x - middle, curvature, x - middle),
        middle, curvature, rationality=4.0, count=20_000, steps=12, rng=rng,
    )  # fmt: skip
    np.testing.assert_array_equal(found.accepted, 1.0)
    assert found.remembered.max() < 1e-3
    expected = np.linalg.inv(4.0 * curvature)
    np.testing.assert_allclose(found.points.mean(axis=0), middle, atol=4 * np.sqrt(expected.max() / 20_000))
    np.testing.assert_allclose(np.cov(found.points.T), expected, atol=0.05 * expected.max())


def test_another_cost_with_a_wall_gives_its_own_distribution(rng: np.random.Generator) -> None:
    def cost(x: np.ndarray) -> np.ndarray:
        return np.where(x[:, 0] >= -0.4, x[:, 0] ** 2 + 2.0 * x[:, 0] ** 4 + 0.3 * x[:, 0] ** 3, np.inf)

    wrong = np.array([[0.7]])  # the curvature is 2: the ratio must make up for it
    found = boltzmann_points(cost, np.zeros(1), wrong, rationality=1.5, count=20_000, steps=200, rng=rng)
    line = np.linspace(-0.4, 3.0, 20_001)
    shares = np.exp(-1.5 * cost(line[:, None]))
    shares /= shares.sum()
    assert found.points.min() >= -0.4
    for power in (1, 2, 3):
        values = found.points[:, 0] ** power
        assert values.mean() == pytest.approx(shares @ line**power, abs=4 * values.std() / np.sqrt(20_000))


def test_the_curvature_is_that_of_the_cost(rng: np.random.Generator) -> None:
    plans = planner(clear=True)
    weights = np.array([-1.0, -2.0, -4.0])
    best = plans.plan(weights, starts=1).trajectory
    demonstrator = Demonstrator(plans, weights, 2.0)
    along = rng.normal(size=best[1:-1].size)
    along *= 1e-3 / np.linalg.norm(along)
    inner = best[1:-1].reshape(-1)
    below, at, above = demonstrator._costs(best, np.stack([inner - along, inner, inner + along]))
    assert along @ demonstrator.curvature(best) @ along == pytest.approx(below - 2 * at + above, rel=1e-3)


def test_an_arm_that_pays_for_speed_alone_deviates_with_the_closed_form_s_covariance(rng: np.random.Generator) -> None:
    plans, weights = planner(clear=True), np.array([0.0, 0.0, -4.0])
    best = plans.plan(weights, starts=1).trajectory
    drawn, chains = Demonstrator(plans, weights, 2.0).draws(best, rationality=2000.0, count=400, steps=30, rng=rng)
    np.testing.assert_array_equal(drawn[:, [0, -1]], np.broadcast_to(best[[0, -1]], (400, 2, 7)))
    assert chains.accepted.mean() > 0.95
    curvature = (2.0 * rest_to_rest(8, plans.dt_s) + 2 * 4.0 * step_squares(8, plans.dt_s))[1:-1, 1:-1]
    away = (drawn - best)[:, 1:-1]
    energies = 2000.0 * np.einsum("btd,ts,bsd->b", away, curvature, away)
    assert energies.mean() == pytest.approx(6 * 7, rel=0.05)  # chi squared with 42 degrees of freedom
    assert energies.var() == pytest.approx(2 * 6 * 7, rel=0.35)
    expected = np.linalg.inv(2000.0 * curvature)
    np.testing.assert_allclose(np.einsum("btd,bsd->ts", away, away) / 2800, expected, atol=0.1 * expected.max())


def test_draws_touch_nothing_and_the_less_rational_pay_more(rng: np.random.Generator) -> None:
    plans, weights = planner(clear=False), np.array([-1.0, -2.0, -4.0])
    plan = plans.plan(weights, starts=4, rng=rng)
    demonstrator, paid = Demonstrator(plans, weights, 2.0), []
    for rationality in (300.0, 30.0):
        drawn, _ = demonstrator.draws(plan.trajectory, rationality=rationality, count=10, steps=200, rng=rng)
        assert (plans.clearance(drawn) >= 0).all()
        assert ((plans.arm.low <= drawn) & (drawn <= plans.arm.high)).all()
        costs = demonstrator._costs(plan.trajectory, drawn[:, 1:-1].reshape(10, -1))
        paid.append(costs.mean() - demonstrator._costs(plan.trajectory, plan.trajectory[None, 1:-1].reshape(1, -1))[0])
    assert 0 < paid[0] < paid[1]


@pytest.mark.parametrize("rationality", [0.0, -1.0, np.nan, np.inf])
def test_bad_input_is_a_sentence(rationality: float, rng: np.random.Generator) -> None:
    one = {"count": 1, "steps": 10, "rng": rng}
    with pytest.raises(InputError, match="give a positive number and at least 2 steps"):
        boltzmann_points(lambda x: x[:, 0], np.zeros(1), np.eye(1), rationality=rationality, **one)
    with pytest.raises(InputError, match="the optimum that deviations begin from costs inf"):
        boltzmann_points(lambda x: x[:, 0] + np.inf, np.zeros(1), np.eye(1), rationality=1.0, **one)
