"""The finite MDPs of `lfd bench irl`, with demonstrators whose reward is known.

- grid-world after Abbeel and Ng 2004: a grid of square regions, whose indicators are the features. A region's true
  weight is 0 with probability 0.9, else uniform in [0, 1]; draws with fewer than two rewarded regions are rejected.
  Their grid has 128 x 128 cells and 8 x 8 regions, ours the regions on fewer cells; gamma = 0.99 as there.
- objectworld after Levine, Popovic, Koltun 2011 (`lfd.planning.objectworld`), with their 32 x 32 cells, slip 0.3,
  gamma = 0.9 and demonstrations of 8 steps; an object in every twentieth cell, two colours, and at least one cell that
  earns something. No weights express its true reward.

Values count T decisions here as well, where the papers let them go on.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfd.planning import GridWorld, TabularMDP, grid_world, objectworld

SLIP = 0.3
REWARDED = 0.1
"""Probability that a region of the grid-world is rewarded."""
BEST_STEP = 3.0
"""Reward of a step in the best cell [nat]: the soft expert prefers it to one that earns nothing by e^3 to 1."""
SOFT, OPTIMAL = "soft expert", "optimal expert"


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """A grid, its true reward, and two experts for it."""

    mdp: TabularMDP
    """With the features that learners get."""
    truth: TabularMDP
    """With the true reward as only feature: mu is then a policy's true value."""
    experts: dict[str, Float[np.ndarray, "T S A"]]
    """The soft policy and an optimal one of the true reward."""
    best: float
    """True value of the optimal policy."""
    uniform: float
    """True value of drawing actions uniformly."""

    def loss(self, value: float) -> float:
        """Expected value difference (V* - V) / (V* - V_uniform): 0 is optimal, 1 as bad as random actions."""
        return (self.best - value) / (self.best - self.uniform)


def macro_grid(*, size: int, block: int, horizon: int, discount: float, rng: np.random.Generator) -> GridWorld:
    """Grid-world of `size` x `size` cells in regions of `block` x `block`; the best region has weight `BEST_STEP`."""
    per_side = size // block
    weights = np.zeros(per_side**2)
    while np.count_nonzero(weights) < 2:
        weights = np.where(rng.random(per_side**2) < REWARDED, rng.random(per_side**2), 0.0)
    region = np.arange(size) // block
    cells = np.eye(per_side**2)[per_side * region[:, None] + region]
    return grid_world(cells, weights=weights * BEST_STEP / weights.max(), slip=SLIP, horizon=horizon, discount=discount)


def problem_of(grid: GridWorld) -> Problem:
    """The experts of a grid and the values to compare with; the best cell's reward becomes `BEST_STEP`."""
    truth, scale = grid.with_true_reward(), np.array([BEST_STEP / grid.true_reward.max()])
    policies = {SOFT: truth.soft_solution(scale).policy, OPTIMAL: truth.optimal_solution(scale).policy}
    return Problem(
        mdp=grid.mdp,
        truth=truth,
        experts=policies,
        best=float(truth.feature_expectation(policies[OPTIMAL])[0]),
        uniform=float(truth.feature_expectation(uniform_policy(truth))[0]),
    )


def make_problem(name: str, *, size: int, rng: np.random.Generator) -> Problem:
    """One of `PROBLEMS` on `size` x `size` cells, `size` a multiple of 8."""
    if name == "grid-world":
        return problem_of(macro_grid(size=size, block=size // 8, horizon=60, discount=0.99, rng=rng))
    objects = size * size // 20
    options = {"objects": objects, "colours": 2, "slip": SLIP, "horizon": 8, "discount": 0.9, "discrete": True}
    grid = objectworld(size, **options, rng=rng)
    while grid.true_reward.max() <= 0:
        grid = objectworld(size, **options, rng=rng)
    return problem_of(grid)


PROBLEMS = ("grid-world", "objectworld")


def uniform_policy(mdp: TabularMDP) -> Float[np.ndarray, "S A"]:
    """Every action with the same probability."""
    states, actions, _ = mdp.features.shape
    return np.full((states, actions), 1.0 / actions)
