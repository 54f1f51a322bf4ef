"""Grid-world and objectworld, as finite MDPs with sparse transitions."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int, Shaped

from lfd.core.errors import InputError
from lfd.planning.tabular_mdp import TabularMDP
from lfd.rewards.checked_arrays import finite_array

MOVES: Int[np.ndarray, "A 2"] = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]])
"""Row and column added by the actions stay, up, down, left, right."""
OUTER_REACH, INNER_REACH = 3, 2
"""Distances [cells] below which objectworld's reward counts objects of the first and of the second outer colour."""


@dataclass(frozen=True, eq=False)
class GridWorld:
    """A grid and the reward that its maker chose; cell (row, column) is state row * width + column."""

    mdp: TabularMDP
    height: int
    width: int
    true_reward: Float[np.ndarray, "S"]
    """Reward of being in each cell, which features need not be able to express."""

    def with_true_reward(self) -> TabularMDP:
        """The same MDP with the true reward as its only feature: mu is then the true value of a policy."""
        reward = np.broadcast_to(self.true_reward[:, None, None], (*self.mdp.features.shape[:2], 1))
        return replace(self.mdp, features=reward)


def grid_transitions(height: int, width: int, slip: float | int) -> sp.csr_array:
    """p(s' | s, a) in row s A + a for the five actions of `MOVES`.

    With probability `slip` a move drawn uniformly from the five takes the place of the chosen one; a move that leads
    off the grid stays. Raises `InputError` for a slip outside [0, 1] and for a grid without cells.
    """
    if not 0.0 <= slip <= 1.0:
        raise InputError(f"slip = {slip}: give a probability in [0, 1]")
    if height < 1 or width < 1:
        raise InputError(f"a grid of {height} x {width} has no cells")
    actions, states = len(MOVES), height * width
    row, column = np.divmod(np.arange(states), width)
    to_row, to_column = row[:, None] + MOVES[:, 0], column[:, None] + MOVES[:, 1]
    inside = (to_row >= 0) & (to_row < height) & (to_column >= 0) & (to_column < width)
    target = np.where(inside, to_row * width + to_column, np.arange(states)[:, None])
    chance = (1.0 - slip) * np.eye(actions) + slip / actions  # of each move, given the chosen one
    where = np.broadcast_to(target[:, None, :], (states, actions, actions))
    data = np.broadcast_to(chance, (states, actions, actions))
    rows = np.repeat(np.arange(states * actions), actions)
    return sp.coo_array((data.reshape(-1), (rows, where.reshape(-1))), (states * actions, states)).tocsr()


def grid_world(
    cell_features: Shaped[np.ndarray, "..."],
    *,
    weights: Shaped[np.ndarray, "..."],
    slip: float | int,
    horizon: int,
    discount: float | int,
    initial: Shaped[np.ndarray, "..."] | None = None,
) -> GridWorld:
    """A grid whose cells have the features `cell_features` (height, width, K) and the true reward w^T phi(cell).

    `initial` (height, width) are probabilities of the first cell, all the same unless given.
    """
    cells = finite_array("cell_features", cell_features, ("height", "width", "K"))
    truth = cells.reshape(-1, cells.shape[2]) @ finite_array("weights", weights, (cells.shape[2],))
    return _grid(cells, truth, slip=slip, horizon=horizon, discount=discount, initial=initial)


def objectworld(
    size: int,
    *,
    objects: int,
    colours: int,
    slip: float | int,
    horizon: int,
    discount: float | int,
    discrete: bool,
    rng: np.random.Generator,
) -> GridWorld:
    """Objectworld of Levine, Popovic, Koltun 2011 ("Nonlinear inverse reinforcement learning with Gaussian processes").

    Objects with an inner and an outer colour lie in random cells of a square grid. The true reward of a cell is 1
    closer than 3 cells to an object of the first outer colour and 2 to one of the second, -1 closer than 3 to the first
    only, else 0 (Euclidean distances). Features are the distances [cells] to the nearest object of each outer, then
    each inner colour; `discrete` ones are the indicators distance < 1, < 2, ..., < size of each, those that differ
    between cells. The reward is not linear in either (it is in products of indicators); inner colours only distract.

    Raises `InputError` where there are not two colours, or more objects than cells or fewer than colours.
    """
    if colours < 2 or not colours <= objects <= size * size:
        raise InputError(
            f"{objects} objects of {colours} colours on {size} x {size} cells: give at least two colours, at least as "
            "many objects as colours and at most as many as cells"
        )
    place = np.stack(np.divmod(rng.choice(size * size, objects, replace=False), size), axis=1)
    # Each colour occurs, inside and outside: a distance to nothing would be infinite.
    outer, inner = (
        rng.permutation(np.r_[np.arange(colours), rng.integers(colours, size=objects - colours)]) for _ in "oi"
    )
    cells = np.stack(np.divmod(np.arange(size * size), size), axis=1)
    distance = np.linalg.norm(cells[:, None] - place, axis=2)
    nearest = np.stack([distance[:, of == c].min(axis=1) for of in (outer, inner) for c in range(colours)], axis=1)
    truth = np.where(nearest[:, 0] < OUTER_REACH, np.where(nearest[:, 1] < INNER_REACH, 1.0, -1.0), 0.0)
    features = nearest
    if discrete:
        features = (nearest[:, :, None] < np.arange(1, size + 1)).reshape(size * size, -1).astype(float)
        features = features[:, np.ptp(features, axis=0) > 0]
    grid = features.reshape(size, size, -1)
    return _grid(grid, truth, slip=slip, horizon=horizon, discount=discount, initial=None)


def _grid(
    cells: Float[np.ndarray, "height width K"],
    truth: Float[np.ndarray, "S"],
    *,
    slip: float | int,
    horizon: int,
    discount: float | int,
    initial: Shaped[np.ndarray, "..."] | None,
) -> GridWorld:
    height, width, count = cells.shape
    states = height * width
    start = np.full((height, width), 1.0 / states) if initial is None else initial
    mdp = TabularMDP(
        transitions=grid_transitions(height, width, slip),
        initial=finite_array("initial", start, (height, width)).reshape(-1),
        features=np.repeat(cells.reshape(states, 1, count), len(MOVES), axis=1),
        horizon=horizon,
        discount=discount,
    )
    return GridWorld(mdp, height, width, truth)
