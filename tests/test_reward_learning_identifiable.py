import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lfd.core.errors import InputError
from lfd.planning import TabularMDP
from lfd.reward_learning import identifiable_directions, identifiable_from_counts, maxent_tabular_objective
from tests.small_mdps import numerical_gradient, random_mdp

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.sampled_from([0.0, 0.8, 1.0]))
@settings(max_examples=20, deadline=None)
def test_the_information_is_minus_the_hessian_of_the_objective(seed: int, discount: float) -> None:
    mdp = random_mdp(seed, states=4, actions=3, features=3, discount=discount)
    weights = np.random.default_rng(seed).normal(size=3)
    information = identifiable_directions(mdp, weights).information
    for k in range(3):
        slope = numerical_gradient(lambda w, k=k: maxent_tabular_objective(mdp, w, np.zeros(3))[1][k], weights)
        np.testing.assert_allclose(information[k], -slope, atol=1e-7)


def with_column(mdp: TabularMDP, column: np.ndarray) -> TabularMDP:
    return dataclasses.replace(mdp, features=np.concatenate([mdp.features, column[:, :, None]], axis=2))


@given(seeds, st.floats(0.1, 10))
@settings(max_examples=20, deadline=None)
def test_what_is_not_told_changes_no_policy_at_any_weights(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    mdp = random_mdp(seed, states=4, actions=3, features=2)
    mixed = with_column(with_column(mdp, scale * (mdp.features @ [2.0, -1.0] + 3.0)), np.full((4, 3), 7.0))
    result = identifiable_directions(mixed, rng.normal(size=4))
    assert result.identified.shape == result.unidentified.shape == (2, 4)
    basis = np.vstack([result.identified, result.unidentified])
    np.testing.assert_allclose(basis @ basis.T, np.eye(4), atol=1e-9)
    for direction in result.unidentified:
        weights = rng.normal(size=4)
        same = mixed.soft_solution(weights + direction / np.abs(mixed.features @ direction).max().clip(1e-3)).policy
        np.testing.assert_allclose(same, mixed.soft_solution(weights).policy, atol=1e-6)


def test_what_only_the_dynamics_decide_is_not_told() -> None:
    mdp = random_mdp(1)
    same_chance = np.repeat(mdp.transitions[:, :1], 2, axis=1)
    drifting = dataclasses.replace(mdp, transitions=same_chance)
    of_the_state = with_column(drifting, np.random.default_rng(1).normal(size=(3, 1)) * np.ones((1, 2)))
    result = identifiable_directions(of_the_state, np.zeros(3))
    np.testing.assert_allclose(np.abs(result.unidentified), [[0, 0, 1]], atol=1e-12)


def test_everything_is_told_by_features_of_their_own() -> None:
    result = identifiable_directions(random_mdp(2), np.zeros(2))
    assert result.identified.shape == (2, 2)
    assert result.unidentified.shape == (0, 2)


def test_features_that_are_the_same_on_all_trajectories() -> None:
    rng = np.random.default_rng(3)
    first = rng.normal(size=20)
    second = rng.normal(size=20)
    counts = np.stack([first, np.full(20, 4.0), 1000 * second, 1 - first], axis=1)
    result = identifiable_from_counts(counts)
    np.testing.assert_allclose(result.information, np.cov(counts.T, bias=True), atol=1e-8)
    assert result.identified.shape == (2, 4)
    assert np.ptp(counts @ result.unidentified.T, axis=0).max() < 1e-10
    with pytest.raises(InputError, match="counts has 1 rows"):
        identifiable_from_counts(counts[:1])
