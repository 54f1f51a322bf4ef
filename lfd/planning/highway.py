"""A discretised highway after Abbeel and Ng 2004: a car that is faster than the traffic and chooses its lane."""

import itertools

import numpy as np
import scipy.sparse as sp

from lfd.core.errors import InputError
from lfd.planning.tabular_mdp import TabularMDP

LEFT, KEEP, RIGHT = range(3)


def highway(*, lanes: int, sight: int, traffic: float | int, horizon: int, discount: float | int) -> TabularMDP:
    """Highway with `lanes` lanes and grass on both sides, where the next car of each lane is seen `sight` cells ahead.

    The state is our column c (0 is the grass on the left, lanes + 1 that on the right) and, for each lane, the gap to
    its next car: 0 alongside, up to sight - 1, or `sight` for a free lane. In a step we move a column to the left,
    keep, or move to the right (at the edge: keep), every gap shrinks by 1, a car alongside falls behind, and a free
    lane gets a car at gap sight - 1 with probability `traffic`, independently. S = (lanes + 2) (sight + 1)^lanes.

    Features of a state: collision (a car alongside in our lane), then one indicator for each column. The indicators
    always sum to 1: one direction of the weights is not identifiable (`identifiable_directions`). The episode
    starts in the middle lane on a free road. Raises `InputError` for numbers out of range.
    """
    if lanes < 1 or sight < 1 or not 0.0 <= traffic <= 1.0:
        raise InputError(
            f"lanes = {lanes}, sight = {sight}, traffic = {traffic}: give at least one lane and one cell of sight, and "
            "a probability in [0, 1]"
        )
    columns, gaps = lanes + 2, list(itertools.product(range(sight + 1), repeat=lanes))
    road = sp.csr_array([[1.0]])
    for _ in range(
        lanes
    ):  # lanes are independent: the joint transition is the Kronecker product, the last lane fastest
        road = sp.kron(road, _next_gap(sight, traffic), format="csr")
    steps = [np.clip(np.arange(columns) + move, 0, columns - 1) for move in (-1, 0, 1)]
    by_action = [sp.kron(sp.csr_array(np.eye(columns)[step]), road, format="csr") for step in steps]
    states = columns * len(gaps)
    order = np.arange(3 * states).reshape(3, states).T.reshape(-1)  # from row a S + s to row s A + a
    features = np.zeros((columns, len(gaps), 1 + columns))
    for column in range(1, lanes + 1):
        features[column, :, 0] = [gap[column - 1] == 0 for gap in gaps]
    features[np.arange(columns), :, 1 + np.arange(columns)] = 1.0
    initial = np.zeros(states)
    initial[(lanes + 1) // 2 * len(gaps) + len(gaps) - 1] = 1.0
    return TabularMDP(
        transitions=sp.csr_array(sp.vstack(by_action))[order],
        initial=initial,
        features=np.repeat(features.reshape(states, 1, -1), 3, axis=1),
        horizon=horizon,
        discount=discount,
    )


def _next_gap(sight: int, traffic: float | int) -> sp.csr_array:
    """p(gap' | gap): one less; from alongside to free; from free to a new car with probability `traffic`."""
    matrix = np.zeros((sight + 1, sight + 1))
    matrix[np.arange(1, sight), np.arange(sight - 1)] = 1.0
    matrix[0, sight] = 1.0
    matrix[sight, sight - 1] += traffic
    matrix[sight, sight] += 1.0 - traffic
    return sp.csr_array(matrix)
