import dataclasses
import itertools

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from lfd.core.errors import InputError
from lfd.planning import TabularMDP
from tests.small_mdps import deterministic_policies, probability, random_mdp, random_policy, trajectories

DISCOUNTS = [0.0, 0.8, 1.0]
seeds = st.integers(0, 2**32 - 1)


def naive_soft_values(mdp: TabularMDP, weights: np.ndarray) -> np.ndarray:
    """Equation by equation, in plain loops."""
    states, actions, _ = mdp.features.shape
    values = np.zeros((mdp.horizon + 1, states))
    for t in reversed(range(mdp.horizon)):
        for s in range(states):
            q = [
                weights @ mdp.features[s, a]
                + mdp.discount * sum(mdp.transitions[s, a, z] * values[t + 1, z] for z in range(states))
                for a in range(actions)
            ]
            values[t, s] = np.log(np.sum(np.exp(q)))
    return values


@pytest.mark.parametrize("discount", DISCOUNTS)
@pytest.mark.parametrize("horizon", [1, 3])
def test_soft_values_and_policy_follow_their_equations(discount: float, horizon: int) -> None:
    mdp = random_mdp(1, states=4, actions=3, discount=discount, horizon=horizon)
    weights = np.array([0.7, -1.3])
    values, policy = mdp.soft_solution(weights)
    assert values.shape == (horizon + 1, 4)
    assert policy.shape == (horizon, 4, 3)
    np.testing.assert_allclose(values, naive_soft_values(mdp, weights), atol=1e-13)
    q = mdp.features @ weights + discount * np.einsum("saz,tz->tsa", mdp.transitions, values[1:])
    np.testing.assert_allclose(policy, np.exp(q - values[:-1, :, None]), atol=1e-13)


def test_soft_value_of_deterministic_dynamics_is_log_sum_over_action_sequences() -> None:
    rng = np.random.default_rng(2)
    following = rng.integers(3, size=(3, 2))
    mdp = TabularMDP(
        transitions=np.eye(3)[following],
        initial=np.eye(3)[1],
        features=rng.normal(size=(3, 2, 2)),
        horizon=4,
        discount=1,
    )
    weights = rng.normal(size=2)
    returns = []
    for actions in itertools.product(range(2), repeat=4):
        state, total = 1, 0.0
        for action in actions:
            total += weights @ mdp.features[state, action]
            state = following[state, action]
        returns.append(total)
    np.testing.assert_allclose(mdp.soft_solution(weights).values[0, 1], np.log(np.exp(returns).sum()), atol=1e-13)


@given(seeds)
@settings(max_examples=20)
def test_soft_policy_maximises_reward_plus_causal_entropy(seed: int) -> None:
    mdp, rng = random_mdp(seed, discount=0.7), np.random.default_rng(seed)
    weights = rng.normal(size=2)
    everything = trajectories(mdp)

    def reward_and_entropy(policy: np.ndarray):
        surprise = [
            -sum(
                mdp.discount**t * np.log(policy[t, x, u])
                for t, (x, u) in enumerate(zip(tau.states, tau.actions, strict=True))
            )
            for tau in everything
        ]
        return sum(
            probability(tau, policy) * (weights @ tau.counts + own)
            for tau, own in zip(everything, surprise, strict=True)
        )

    values, policy = mdp.soft_solution(weights)
    assert reward_and_entropy(policy) == pytest.approx(mdp.initial @ values[0], abs=1e-10)
    assert reward_and_entropy(random_policy(mdp, rng)) <= mdp.initial @ values[0] + 1e-10


@pytest.mark.parametrize("discount", DISCOUNTS)
def test_optimal_values_are_the_best_of_all_deterministic_policies(discount: float) -> None:
    mdp = random_mdp(3, states=3, actions=2, horizon=3, discount=discount)
    weights = np.array([1.0, -0.4])
    values, policy = mdp.optimal_solution(weights)
    best = max(weights @ mdp.feature_expectation(each) for each in deterministic_policies(mdp))
    assert mdp.initial @ values[0] == pytest.approx(best, abs=1e-12)
    assert weights @ mdp.feature_expectation(policy) == pytest.approx(best, abs=1e-12)
    assert set(np.unique(policy)) == {0.0, 1.0}


def test_of_equally_good_actions_the_first_is_taken() -> None:
    mdp = random_mdp(4, actions=3)
    np.testing.assert_array_equal(mdp.optimal_solution(np.zeros(2)).policy[:, :, 0], 1.0)


def test_rewards_of_each_time_step_count_as_they_are() -> None:
    mdp = random_mdp(5, discount=0.6)
    weights = np.array([0.3, 2.0])
    discounted = 0.6 ** np.arange(3)[:, None, None] * mdp.reward(weights)
    changing, same = mdp.optimal_for(discounted), mdp.optimal_solution(weights)
    np.testing.assert_array_equal(changing.policy, same.policy)
    np.testing.assert_allclose(changing.values[0], same.values[0], atol=1e-13)


@pytest.mark.parametrize("discount", DISCOUNTS)
@pytest.mark.parametrize("horizon", [1, 3])
def test_occupancy_and_feature_expectation_are_sums_over_trajectories(discount: float, horizon: int) -> None:
    mdp = random_mdp(6, discount=discount, horizon=horizon)
    policy = random_policy(mdp, np.random.default_rng(6))
    occupancy, mu = np.zeros((horizon, 3)), np.zeros(2)
    for tau in trajectories(mdp):
        mu += probability(tau, policy) * tau.counts
        for t, state in enumerate(tau.states):
            occupancy[t, state] += probability(tau, policy)
    np.testing.assert_allclose(mdp.occupancy(policy), occupancy, atol=1e-13)
    np.testing.assert_allclose(mdp.feature_expectation(policy), mu, atol=1e-13)


def test_a_stationary_policy_is_the_same_at_every_time() -> None:
    mdp = random_mdp(7)
    stationary = random_policy(mdp, np.random.default_rng(7))[0]
    repeated = np.stack([stationary] * mdp.horizon)
    np.testing.assert_array_equal(mdp.occupancy(stationary), mdp.occupancy(repeated))
    np.testing.assert_array_equal(mdp.feature_expectation(stationary), mdp.feature_expectation(repeated))


@pytest.mark.parametrize("states", [4, 80])  # below and above the size at which products become sparse
@pytest.mark.parametrize("form", [sp.csr_array, sp.csr_matrix, sp.coo_array, sp.csc_array])
def test_sparse_transitions_give_what_dense_ones_give(states: int, form) -> None:
    rng = np.random.default_rng(8)
    chance = np.zeros((states, 3, states))
    for s, a in itertools.product(range(states), range(3)):
        chance[s, a, rng.choice(states, 3, replace=False)] = rng.dirichlet(np.ones(3))
    rest = {
        "initial": rng.dirichlet(np.ones(states)),
        "features": rng.normal(size=(states, 3, 2)),
        "horizon": 5,
        "discount": 0.9,
    }
    dense = TabularMDP(transitions=chance, **rest)
    sparse = TabularMDP(transitions=form(chance.reshape(-1, states)), **rest)
    weights = rng.normal(size=2)
    expected = naive_soft_values(dense, weights) if states == 4 else dense.soft_solution(weights).values
    for mdp in (dense, sparse):
        values, policy = mdp.soft_solution(weights)
        np.testing.assert_allclose(values, expected, atol=1e-12)
        occupancy = [dense.initial]
        for t in range(4):
            occupancy.append(np.einsum("s,sa,saz->z", occupancy[-1], policy[t], chance))
        np.testing.assert_allclose(mdp.occupancy(policy), occupancy, atol=1e-13)
        np.testing.assert_array_equal(mdp.optimal_solution(weights).policy, dense.optimal_solution(weights).policy)


def test_samples_have_the_policy_s_feature_expectation_and_no_impossible_transition() -> None:
    mdp = random_mdp(9, states=4, actions=3, horizon=4)
    rng = np.random.default_rng(9)
    policy = random_policy(mdp, rng)
    policy[:, :, 1] = 0.0
    policy /= policy.sum(axis=2, keepdims=True)
    states, actions = mdp.sample(policy, 20_000, rng)
    assert states.shape == (20_000, 5)
    assert actions.shape == (20_000, 4)
    assert (actions != 1).all()
    assert (mdp.transitions[states[:, :-1], actions, states[:, 1:]] > 0).all()
    counts = np.einsum("t,ntk->nk", mdp.discount ** np.arange(4), mdp.features[states[:, :-1], actions])
    error = counts.std(axis=0, ddof=1) / np.sqrt(len(counts))
    assert (np.abs(counts.mean(axis=0) - mdp.feature_expectation(policy)) < 5 * error).all()
    for t in range(4):
        share = np.bincount(states[:, t], minlength=4) / 20_000
        np.testing.assert_allclose(share, mdp.occupancy(policy)[t], atol=0.02)


def test_the_same_generator_gives_the_same_samples() -> None:
    mdp = random_mdp(10)
    policy = random_policy(mdp, np.random.default_rng(0))
    first, second = (mdp.sample(policy, 5, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(first.states, second.states)
    np.testing.assert_array_equal(first.actions, second.actions)


@given(seeds, st.floats(-5, 5))
@settings(max_examples=20)
def test_a_constant_on_a_feature_changes_no_policy(seed: int, constant: float) -> None:
    mdp, weights = random_mdp(seed), np.random.default_rng(seed).normal(size=2)
    moved = dataclasses.replace(mdp, features=mdp.features + np.array([constant, 0.0]))
    np.testing.assert_allclose(moved.soft_solution(weights).policy, mdp.soft_solution(weights).policy, atol=1e-9)
    away = constant * (mdp.discount ** np.arange(mdp.horizon)).sum() * np.array([1.0, 0.0])
    policy = mdp.soft_solution(weights).policy
    np.testing.assert_allclose(moved.feature_expectation(policy), mdp.feature_expectation(policy) + away, atol=1e-9)


def test_large_rewards_do_not_overflow() -> None:
    mdp = random_mdp(11)
    values, policy = mdp.soft_solution(np.array([1e6, -1e6]))
    np.testing.assert_allclose(policy.sum(axis=2), 1.0)
    np.testing.assert_allclose(values, mdp.optimal_solution(np.array([1e6, -1e6])).values, rtol=1e-6)


def test_arrays_are_copies_that_cannot_be_written() -> None:
    features = np.random.default_rng(0).normal(size=(2, 1, 1))
    transitions = sp.csr_array(np.eye(2))
    mdp = TabularMDP(transitions=transitions, initial=np.array([1, 0]), features=features, horizon=2, discount=0.5)
    features[:] = np.nan
    transitions.data[:] = 7.0
    assert np.isfinite(mdp.features).all()
    assert mdp.initial.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        mdp.features[0, 0, 0] = 1.0


def broken(**changes) -> TabularMDP:
    parts = {
        "transitions": np.full((2, 2, 2), 0.5),
        "initial": np.array([0.5, 0.5]),
        "features": np.ones((2, 2, 1)),
        "horizon": 3,
        "discount": 0.9,
    }
    return TabularMDP(**(parts | changes))


def changed(array: np.ndarray, place: tuple[int, ...], value: float) -> np.ndarray:
    array = array.copy()
    array[place] = value
    return array


HALF = np.full((2, 2, 2), 0.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transitions": changed(HALF, (1, 0, 1), 0.4)}, "transitions of state 1, action 0 sum to 0.9, not to 1"),
        ({"transitions": changed(HALF, (0, 1, 0), -0.5)}, "state 0, action 1: the probability of state 0 is -0.5"),
        ({"transitions": changed(HALF, (1, 1, 0), np.nan)}, "state 1, action 1: the probability of state 0 is nan"),
        ({"transitions": sp.csr_array(changed(HALF, (1, 0, 1), 0.4).reshape(4, 2))}, "state 1, action 0 sum to 0.9"),
        ({"transitions": np.full((2, 3, 2), 0.5)}, r"transitions have shape \(2, 3, 2\); with 2 actions"),
        ({"transitions": np.full((3, 2, 3), 1 / 3)}, "features have 2 states, transitions have 3"),
        ({"transitions": np.zeros((2, 2, 2))}, "state 0, action 0 sum to 0, not to 1, and those of 3 other rows"),
        ({"initial": np.array([0.5, 0.6])}, "initial does not sum to 1"),
        ({"initial": np.array([1.5, -0.5])}, "initial has a negative probability"),
        ({"initial": np.ones(3) / 3}, r"initial has shape \(3,\), expected \(2,\)"),
        ({"features": changed(np.ones((2, 2, 1)), (1, 0, 0), np.nan)}, r"features\[1, 0, 0\] is nan"),
        ({"features": np.ones((2, 2))}, r"features has shape \(2, 2\), expected \(S, A, K\)"),
        ({"horizon": 0}, "horizon = 0"),
        ({"discount": -0.1}, "discount = -0.1"),
        ({"discount": 1.5}, "discount = 1.5"),
    ],
)
def test_a_wrong_mdp_is_refused_with_its_row(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        broken(**changes)


def test_constant_features_can_be_planned_with() -> None:
    assert broken().optimal_solution(np.ones(1)).values[0, 0] == pytest.approx(1 + 0.9 + 0.81)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (np.ones((2, 2)), "policy of state 0 does not sum to 1"),
        (np.array([[0.5, 0.5], [1.5, -0.5]]), "policy of state 1 has a negative probability"),
        (changed(np.full((3, 2, 2), 0.5), (2, 1, 0), 0.6), "policy of time step 2, state 1 does not sum to 1"),
        (np.full((2, 2, 2), 0.5), r"policy has shape \(2, 2, 2\), expected \(3, 2, 2\)"),
    ],
)
def test_a_wrong_policy_is_refused_with_its_row(policy: np.ndarray, message: str) -> None:
    for use in (broken().occupancy, broken().feature_expectation):
        with pytest.raises(InputError, match=message):
            use(policy)


def test_weights_of_another_size_are_refused() -> None:
    for solve in (broken().soft_solution, broken().optimal_solution):
        with pytest.raises(InputError, match=r"weights has shape \(2,\), expected \(1,\)"):
            solve(np.ones(2))
