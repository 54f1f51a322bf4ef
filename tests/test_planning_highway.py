import itertools

import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning import highway
from lfd.reward_learning import identifiable_directions

LANES, SIGHT, TRAFFIC = 2, 2, 0.3


def test_transitions_one_by_one() -> None:
    mdp = highway(lanes=LANES, sight=SIGHT, traffic=TRAFFIC, horizon=3, discount=0.9)
    states = list(itertools.product(range(LANES + 2), *[range(SIGHT + 1)] * LANES))
    number = {state: i for i, state in enumerate(states)}
    expected = np.zeros((len(states), 3, len(states)))
    for (column, *gaps), action in itertools.product(states, range(3)):
        to = min(max(column + action - 1, 0), LANES + 1)
        for new in itertools.product((False, True), repeat=LANES):
            chance, following = 1.0, []
            for gap, appears in zip(gaps, new, strict=True):
                if gap == SIGHT:
                    chance *= TRAFFIC if appears else 1 - TRAFFIC
                    following.append(SIGHT - 1 if appears else SIGHT)
                else:
                    chance *= 0.5  # this lane draws nothing: both branches are the same
                    following.append(gap - 1 if gap > 0 else SIGHT)
            expected[number[(column, *gaps)], action, number[(to, *following)]] += chance
    np.testing.assert_allclose(mdp.transitions.toarray().reshape(expected.shape), expected, atol=1e-15)
    for i, (column, *gaps) in enumerate(states):
        collision = 0 < column <= LANES and gaps[column - 1] == 0
        np.testing.assert_array_equal(mdp.features[i, 0], [collision, *np.eye(LANES + 2)[column]])


def test_who_avoids_collisions_has_none() -> None:
    mdp = highway(lanes=3, sight=3, traffic=0.4, horizon=20, discount=1.0)
    weights = np.array([-10.0, -1, 0, 0, 0, -1])  # no grass unless it must be
    assert mdp.feature_expectation(mdp.optimal_solution(weights).policy)[0] == 0
    assert mdp.feature_expectation(np.full((320, 3), 1 / 3))[0] > 0.5


def test_the_sum_of_the_columns_is_what_demonstrations_do_not_tell() -> None:
    told = identifiable_directions(highway(lanes=3, sight=3, traffic=0.4, horizon=20, discount=0.9), np.zeros(6))
    assert told.identified.shape == (5, 6)
    np.testing.assert_allclose(np.abs(told.unidentified), [[0, *[1 / np.sqrt(5)] * 5]], atol=1e-9)


def test_numbers_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="lanes = 0, sight = 3, traffic = 0.1"):
        highway(lanes=0, sight=3, traffic=0.1, horizon=3, discount=0.9)
