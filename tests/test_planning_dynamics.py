import itertools

import numpy as np
import pytest
import scipy.sparse as sp

from lfd.planning.dynamics import Dynamics, make_dynamics
from tests.small_mdps import random_mdp


@pytest.mark.parametrize("sparse", [False, True])
def test_possible_are_the_transitions_of_positive_probability(sparse: bool) -> None:
    table = random_mdp(4, states=5, actions=3).transitions
    dynamics = make_dynamics(sp.csr_array(table.reshape(15, 5)) if sparse else table, 3)
    states, actions, following = np.array(list(itertools.product(range(5), range(3), range(5)))).T
    assert 0 < (table > 0).mean() < 1
    np.testing.assert_array_equal(dynamics.possible(states, actions, following), table[states, actions, following] > 0)


def test_the_table_of_what_is_possible_is_made_once_whatever_the_order_of_the_rows() -> None:
    one = np.array([0])
    rows = sp.csr_array((np.array([0.5, 0.5, 1.0]), np.array([1, 0, 1]), np.array([0, 2, 3])), shape=(2, 2))
    dynamics = Dynamics(2, 1, rows)  # row 0 has its columns in falling order
    assert dynamics.possible(one, one, one)[0]
    kept = dynamics._possible
    assert not dynamics.possible(one + 1, one, one)[0]
    assert dynamics._possible is kept
