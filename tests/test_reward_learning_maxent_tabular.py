import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lfd.core.errors import InputError
from lfd.planning import TabularMDP, expectation_of_demonstrations, grid_world, log_likelihood
from lfd.reward_learning import maxent_tabular, maxent_tabular_objective
from tests.small_mdps import numerical_gradient, probability, random_mdp, random_policy, trajectories

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.sampled_from([0.0, 0.7, 1.0]), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_the_gradient_is_that_of_the_objective(seed: int, discount: float, horizon: int) -> None:
    rng = np.random.default_rng(seed)
    mdp = random_mdp(seed, states=4, actions=3, features=3, discount=discount, horizon=horizon)
    weights, expert = rng.normal(size=3), rng.normal(size=3)
    value, gradient = maxent_tabular_objective(mdp, weights, expert)
    assert value == pytest.approx(weights @ expert - mdp.initial @ mdp.soft_solution(weights).values[0])
    np.testing.assert_allclose(
        gradient, numerical_gradient(lambda w: maxent_tabular_objective(mdp, w, expert)[0], weights), atol=1e-7
    )
    np.testing.assert_allclose(
        gradient, expert - mdp.feature_expectation(mdp.soft_solution(weights).policy), atol=1e-12
    )


@given(seeds, st.sampled_from([0.0, 0.6, 1.0]))
@settings(max_examples=20, deadline=None)
def test_the_objective_is_the_expected_discounted_log_likelihood_of_the_expert_s_actions(
    seed: int, discount: float
) -> None:
    mdp, rng = random_mdp(seed, discount=discount), np.random.default_rng(seed)
    expert, weights = random_policy(mdp, rng), rng.normal(size=2)
    policy = mdp.soft_solution(weights).policy
    expected = sum(
        probability(tau, expert)
        * sum(
            discount**t * np.log(policy[t, x, u]) for t, (x, u) in enumerate(zip(tau.states, tau.actions, strict=True))
        )
        for tau in trajectories(mdp)
    )
    assert maxent_tabular_objective(mdp, weights, mdp.feature_expectation(expert))[0] == pytest.approx(expected)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_the_objective_is_concave(seed: int) -> None:
    mdp, rng = random_mdp(seed), np.random.default_rng(seed)
    expert, first, second = rng.normal(size=(3, 2))
    ends = [maxent_tabular_objective(mdp, w, expert)[0] for w in (first, second)]
    assert maxent_tabular_objective(mdp, (first + second) / 2, expert)[0] >= np.mean(ends) - 1e-12


@given(seeds, st.sampled_from([0.5, 0.9, 1.0]))
@settings(max_examples=20, deadline=None)
def test_weights_of_a_soft_expert_are_found_again(seed: int, discount: float) -> None:
    mdp = random_mdp(seed, states=4, actions=3, discount=discount, horizon=4)
    weights = np.random.default_rng(seed).normal(size=2)
    expert = mdp.feature_expectation(mdp.soft_solution(weights).policy)
    result = maxent_tabular(mdp, expert)
    assert result.converged
    assert np.linalg.norm(result.gradient) <= 1e-8
    np.testing.assert_allclose(result.weights, weights, atol=1e-5)
    np.testing.assert_allclose(result.mu, expert, atol=1e-8)
    np.testing.assert_allclose(result.policy, mdp.soft_solution(weights).policy, atol=1e-6)
    assert result.objective == pytest.approx(maxent_tabular_objective(mdp, weights, expert)[0], abs=1e-10)


def test_of_policies_with_the_expert_s_features_it_has_the_most_entropy() -> None:
    mdp, rng = random_mdp(1, discount=1.0), np.random.default_rng(1)
    expert = random_policy(mdp, rng)
    result = maxent_tabular(mdp, mdp.feature_expectation(expert))

    def entropy(policy: np.ndarray) -> float:
        return float(-(mdp.occupancy(policy)[:, :, None] * policy * np.log(policy)).sum())

    assert result.converged
    assert entropy(result.policy) > entropy(expert)
    assert entropy(result.policy) == pytest.approx(-result.objective)


def test_the_regulariser_is_part_of_objective_and_gradient() -> None:
    mdp = random_mdp(2)
    expert = mdp.feature_expectation(mdp.soft_solution(np.array([2.0, -1.0])).policy)
    result = maxent_tabular(mdp, expert, l2=0.3)
    assert result.converged
    np.testing.assert_allclose(expert - result.mu, 0.3 * result.weights, atol=1e-8)
    np.testing.assert_allclose(result.feature_gap, expert - result.mu, atol=1e-15)
    plain = maxent_tabular_objective(mdp, result.weights, expert)[0]
    assert result.objective == pytest.approx(plain - 0.15 * result.weights @ result.weights)
    assert result.log_likelihood == pytest.approx(plain)

    def regularised(weights: np.ndarray) -> float:
        return maxent_tabular_objective(mdp, weights, expert)[0] - 0.15 * float(weights @ weights)

    np.testing.assert_allclose(numerical_gradient(regularised, result.weights), result.gradient, atol=1e-7)


@pytest.mark.parametrize("factor", [2.0, 50.0])
def test_an_expert_out_of_reach_is_not_reported_as_found(factor: float) -> None:
    mdp = random_mdp(3)
    expert = factor * mdp.feature_expectation(mdp.optimal_solution(np.array([1.0, 1.0])).policy) + factor
    result = maxent_tabular(mdp, expert)
    assert not result.converged
    assert np.isfinite(result.weights).all()
    assert np.linalg.norm(result.gradient) > 1e-8
    assert maxent_tabular(mdp, expert, l2=0.1).converged


@pytest.mark.parametrize("l2", [1e-6, 1e-3, 1.0])
def test_an_optimal_expert_has_weights_with_any_regulariser(l2: float) -> None:
    mdp = grid_world(
        np.random.default_rng(9).normal(size=(5, 5, 3)), weights=np.ones(3), slip=0.1, horizon=10, discount=0.95
    ).mdp
    expert = mdp.feature_expectation(mdp.optimal_solution(np.array([1.0, -0.5, 0.2])).policy)
    result = maxent_tabular(mdp, expert, l2=l2)
    assert result.converged
    np.testing.assert_allclose(result.feature_gap, l2 * result.weights, atol=1e-8)


def test_iterations_that_run_out_are_reported() -> None:
    mdp = random_mdp(4)
    expert = mdp.feature_expectation(mdp.soft_solution(np.array([3.0, -3.0])).policy)
    assert not maxent_tabular(mdp, expert, max_iterations=1).converged


def gamble() -> TabularMDP:
    """The example of the module: in state 0 action 0 is safe, 1 risky; state 3 pays."""
    transitions = np.zeros((4, 2, 4))
    transitions[0, 0, 1] = 1.0
    transitions[0, 1, 2] = transitions[0, 1, 3] = 0.5
    transitions[[1, 2, 3], :, 1] = 1.0
    features = np.zeros((4, 2, 1))
    features[3] = 1.0
    return TabularMDP(transitions=transitions, initial=np.eye(4)[0], features=features, horizon=2, discount=1.0)


def test_three_distributions_by_enumeration() -> None:
    mdp, weights = gamble(), np.array([2.0])
    everything = trajectories(mdp)
    worth = np.array([np.exp(weights @ tau.counts) for tau in everything])
    chance = np.array([tau.chance for tau in everything])
    risky = np.array([tau.actions[0] == 1 for tau in everything])
    lucky = np.array([tau.states[1] == 3 for tau in everything])
    policy = mdp.soft_solution(weights).policy
    causal = np.array([probability(tau, policy) for tau in everything])
    chapter, ziebart_2008 = worth / worth.sum(), worth * chance / (worth * chance).sum()

    e = np.e
    assert chapter @ risky == pytest.approx((1 + e**2) / (2 + e**2))
    assert ziebart_2008 @ risky == pytest.approx((1 + e**2) / (3 + e**2))
    assert causal @ risky == pytest.approx(e / (1 + e))
    assert policy[0, 0, 1] == pytest.approx(e / (1 + e))
    assert np.round([chapter @ risky, ziebart_2008 @ risky, causal @ risky], 3).tolist() == [0.893, 0.807, 0.731]
    assert (ziebart_2008 @ lucky) / (ziebart_2008 @ risky) == pytest.approx(e**2 / (1 + e**2))
    assert (causal @ lucky) / (causal @ risky) == pytest.approx(0.5)


def test_the_three_agree_where_dynamics_are_deterministic() -> None:
    rng = np.random.default_rng(5)
    mdp = TabularMDP(
        transitions=np.eye(3)[rng.integers(3, size=(3, 2))],
        initial=np.eye(3)[0],
        features=rng.normal(size=(3, 2, 2)),
        horizon=3,
        discount=1.0,
    )
    weights = rng.normal(size=2)
    everything = trajectories(mdp)
    worth = np.array([np.exp(weights @ tau.counts) for tau in everything])
    policy = mdp.soft_solution(weights).policy
    np.testing.assert_allclose([probability(tau, policy) for tau in everything], worth / worth.sum(), atol=1e-12)
    expert = everything[3].counts
    value, gradient = maxent_tabular_objective(mdp, weights, expert)
    assert value == pytest.approx(weights @ expert - np.log(worth.sum()))
    np.testing.assert_allclose(gradient, expert - worth @ [tau.counts for tau in everything] / worth.sum(), atol=1e-12)


def test_more_demonstrations_bring_the_weights_nearer_and_the_likelihood_above_the_truth_s() -> None:
    rng = np.random.default_rng(6)
    mdp = grid_world(rng.normal(size=(5, 5, 3)), weights=np.ones(3), slip=0.1, horizon=8, discount=1.0).mdp
    truth = np.array([1.0, -0.5, 0.3])
    policy = mdp.soft_solution(truth).policy
    errors = []
    for count in (20, 20_000):
        demonstrations = list(zip(*mdp.sample(policy, count, rng), strict=True))
        result = maxent_tabular(mdp, expectation_of_demonstrations(mdp, demonstrations).mean, l2=1e-3)
        assert result.converged
        errors.append(np.linalg.norm(result.weights - truth))
    assert errors[1] < errors[0]
    assert errors[1] < 0.05
    # The expert's states and first states differ from those expected by chance alone, which vanishes with their number.
    found = log_likelihood(mdp, result.policy, demonstrations)
    assert found == pytest.approx(log_likelihood(mdp, policy, demonstrations), abs=1e-2)


def test_constant_features_are_named() -> None:
    mdp = random_mdp(7, features=3)
    features = mdp.features.copy()
    features[:, :, 1] = 4.2
    constant = TabularMDP(transitions=mdp.transitions, initial=mdp.initial, features=features, horizon=3, discount=0.9)
    with pytest.raises(InputError, match=r"features\[:, :, k\] is constant for k = 1: .* leave it out"):
        maxent_tabular(constant, np.zeros(3))


def test_sizes_that_differ_are_refused() -> None:
    mdp = random_mdp(8)
    with pytest.raises(InputError, match=r"mu_expert has shape \(3,\), expected \(2,\)"):
        maxent_tabular(mdp, np.zeros(3))
    with pytest.raises(InputError, match=r"weights has shape \(1,\), expected \(2,\)"):
        maxent_tabular_objective(mdp, np.zeros(1), np.zeros(2))
    with pytest.raises(InputError, match="l2 = -1"):
        maxent_tabular(mdp, np.zeros(2), l2=-1.0)
