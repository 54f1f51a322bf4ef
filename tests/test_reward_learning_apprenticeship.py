import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning import TabularMDP, grid_world
from lfd.reward_learning import Apprenticeship, apprenticeship, max_margin
from tests.small_mdps import deterministic_policies, random_mdp


def learn(mdp: TabularMDP, expert: np.ndarray, tolerance: float = 1e-9, max_iterations: int = 100) -> Apprenticeship:
    states, actions, _ = mdp.features.shape
    return apprenticeship(
        expert,
        lambda weights: mdp.feature_expectation(mdp.optimal_solution(weights).policy),
        initial=mdp.feature_expectation(np.full((states, actions), 1 / actions)),
        tolerance=tolerance,
        max_iterations=max_iterations,
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_mixture_matches_an_expert_who_can_be_matched(seed: int) -> None:
    mdp = random_mdp(seed, features=3)
    rng = np.random.default_rng(seed)
    corners = np.array([mdp.feature_expectation(policy) for policy in list(deterministic_policies(mdp))[::37]])
    expert = rng.dirichlet(np.ones(len(corners))) @ corners
    result = learn(mdp, expert)
    assert result.converged
    assert result.margins[-1] <= 1e-9
    assert len(result.margins) == len(result.mus) == len(result.mixture) == len(result.planned_for) + 1
    np.testing.assert_allclose(result.mixture @ result.mus, expert, atol=1e-8)
    assert (np.diff(result.margins) <= 1e-12).all()
    distances = np.linalg.norm(result.mus - expert, axis=1)
    assert result.best == distances.argmin()
    assert result.best_distance == pytest.approx(distances.min())
    for weights, mu in zip(result.planned_for, result.mus[1:], strict=True):
        np.testing.assert_array_equal(mdp.feature_expectation(mdp.optimal_solution(weights).policy), mu)


def test_the_best_policy_can_be_far_away_though_the_margin_is_zero() -> None:
    corners = np.array([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8]])
    result = apprenticeship(
        np.zeros(2), lambda w: corners[(corners @ w).argmax()], initial=corners[0], tolerance=1e-9, max_iterations=10
    )
    assert result.converged
    np.testing.assert_allclose(result.mixture @ result.mus, 0, atol=1e-12)
    assert result.best_distance > 0.9


def test_out_of_reach_the_margin_is_the_distance_to_all_policies() -> None:
    mdp = random_mdp(7)
    everything = np.array([mdp.feature_expectation(policy) for policy in deterministic_policies(mdp)])
    expert = everything.mean(axis=0) + np.array([10.0, 3.0])
    result = learn(mdp, expert)
    assert not result.converged
    assert len(result.margins) < 100
    assert result.margins[-1] == pytest.approx(max_margin(expert, everything).margin, abs=1e-9)


def test_a_mixture_is_within_the_margin_for_every_reward() -> None:
    rng = np.random.default_rng(0)
    mdp = grid_world(rng.normal(size=(6, 6, 4)), weights=np.ones(4), slip=0.2, horizon=12, discount=0.95).mdp
    expert = mdp.feature_expectation(mdp.optimal_solution(np.array([1.0, -1, 0.5, 0])).policy)
    result = learn(mdp, expert, tolerance=0.05)
    assert result.converged
    for _ in range(20):
        weights = rng.normal(size=4)
        weights /= np.linalg.norm(weights)
        assert abs(weights @ (result.mixture @ result.mus - expert)) <= 0.05


def test_it_stops_after_the_iterations_allowed() -> None:
    mdp = random_mdp(1)
    expert = mdp.feature_expectation(mdp.soft_solution(np.array([1.0, 1.0])).policy)
    result = learn(mdp, expert, max_iterations=1)
    assert result.margins.shape == (1,)
    assert not result.converged
    with pytest.raises(InputError, match="max_iterations = 0"):
        learn(mdp, expert, max_iterations=0)


def test_arrays_of_other_sizes_are_refused() -> None:
    with pytest.raises(InputError, match=r"initial has shape \(3,\), expected \(2,\)"):
        apprenticeship(np.ones(2), lambda w: w, initial=np.ones(3), tolerance=0.1, max_iterations=3)
    with pytest.raises(InputError, match=r"mu of plan\(weights\) has shape \(1,\), expected \(2,\)"):
        apprenticeship(np.ones(2), lambda w: w[:1], initial=np.zeros(2), tolerance=0.1, max_iterations=3)
