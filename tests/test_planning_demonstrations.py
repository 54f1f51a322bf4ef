import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning import TabularMDP, demonstrated_features, expectation_of_demonstrations, log_likelihood
from lfd.rewards import feature_counts
from tests.small_mdps import random_mdp, random_policy

CORRIDOR = TabularMDP(
    transitions=np.eye(3)[[[0, 1], [0, 2], [1, 2]]],
    initial=np.array([0.5, 0.5, 0.0]),
    features=np.arange(6.0).reshape(3, 2, 1),
    horizon=3,
    discount=0.5,
)
"""Three places in a row; action 0 goes left, 1 goes right."""


@pytest.mark.parametrize("states", [[0, 1, 2, 2], [0, 1, 2]])  # the last state need not be known
def test_features_of_a_demonstration(states: list[int]) -> None:
    phi = demonstrated_features(CORRIDOR, np.array(states), np.array([1, 1, 1]))
    np.testing.assert_array_equal(phi, [[1.0], [3.0], [5.0]])
    np.testing.assert_allclose(feature_counts(phi, discount=0.5), [1 + 1.5 + 1.25])


def test_expectation_is_the_mean_over_demonstrations() -> None:
    result = expectation_of_demonstrations(
        CORRIDOR, [(np.array([0, 1]), np.array([1])), (np.array([1]), np.array([0]))]
    )
    np.testing.assert_allclose(result.mean, [1.5])
    np.testing.assert_allclose(result.standard_error, [0.5])


@pytest.mark.parametrize(
    ("states", "actions", "message"),
    [
        ([0, 1, 1], [1, 1], "demonstration 1, step 1: action 1 in state 1 never leads to state 1"),
        ([0, 0, 0], [0, 0, 1, 1], "demonstration 1, 3 states and 4 actions"),
        ([2, 1], [0], "demonstration 1, step 0: the demonstration starts in state 2"),
        ([0, 3], [1], "demonstration 1, step 1: state 3 does not exist; states are 0 to 2"),
        ([0, 1], [2], "demonstration 1, step 0: action 2 does not exist; actions are 0 to 1"),
        ([0.0, 1.0], [1], "demonstration 1, states must be a row of whole numbers"),
    ],
)
def test_an_impossible_demonstration_is_named(states: list, actions: list[int], message: str) -> None:
    good = (np.array([0, 1]), np.array([1]))
    with pytest.raises(InputError, match=message):
        expectation_of_demonstrations(CORRIDOR, [good, (np.array(states), np.array(actions))])


def test_no_demonstration_is_an_error() -> None:
    with pytest.raises(InputError, match="no trajectory is given"):
        expectation_of_demonstrations(CORRIDOR, [])


def test_log_likelihood_is_the_mean_over_demonstrations_of_the_sum_over_steps() -> None:
    mdp = random_mdp(0)
    policy = random_policy(mdp, np.random.default_rng(0))
    states, actions = mdp.sample(policy, 4, np.random.default_rng(1))
    expected = np.mean(
        [sum(np.log(policy[t, x[t], u[t]]) for t in range(3)) for x, u in zip(states, actions, strict=True)]
    )
    assert log_likelihood(mdp, policy, list(zip(states, actions, strict=True))) == pytest.approx(expected)


def test_log_likelihood_of_what_the_policy_never_does() -> None:
    never = np.array([[1.0, 0.0]] * 3)
    assert log_likelihood(CORRIDOR, never, [(np.array([0, 1]), np.array([1]))]) == -np.inf
    with pytest.raises(InputError, match="demonstration 0 has 4 actions, the policy is made for 3"):
        log_likelihood(CORRIDOR, never, [(np.array([0, 0, 0, 0]), np.array([0, 0, 0, 0]))])
