"""Trajectories of a demonstrator who is rational only so far:

    p(tau) ~ exp(-beta cost(tau)),    cost = -w . f + prior + penalties for coming near to things,

the model of maximum entropy (chapter 10.7), on trajectories that touch nothing and keep to the joint limits. They are
drawn by Markov chains from an optimum m. With H the curvature there, the cost is 1/2 (x - m) . H (x - m) and a rest r.
A chain proposes (preconditioned Crank-Nicolson; Cotter, Roberts, Stuart and White 2013)

    x' = m + sqrt(1 - s^2) (x - m) + s xi,    xi ~ N(0, (beta H)^-1),

and accepts with min(1, exp(beta (r(x) - r(x')))). The proposals keep Laplace's approximation N(m, (beta H)^-1), so that
the ratio is exact, and all are accepted where the cost is quadratic. In the first half of a chain s follows its rate of
acceptance; then it is fixed, as a chain has to be. Other optima are seen as far as chains get there.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from lfd.core.errors import InputError
from lfd.planning.arm_planner import MARGIN_M, STIFFNESS, ArmPlanner
from lfd.planning.signed_distances import table_of
from lfd.planning.trajectory_costs import TrajectoryCost, rest_to_rest

Cost = Callable[[Float[np.ndarray, "B N"]], Float[np.ndarray, "B"]]
"""Costs of B points; inf where one cannot be."""
ACCEPTED = 0.4
"""Rate of acceptance that s is led to; the best for a random walk is 0.44 in one dimension and 0.23 in many (Roberts,
Gelman and Gilks 1997)."""
STEP_RAD = 1e-4
"""Of the central differences of the gradient."""
FLATTEST = 1e-5
"""Least curvature of the reference, as a share of the largest: beside an optimum that is not quite one H may be
negative."""


@dataclass(frozen=True)
class Chains:
    """The ends of some independent chains."""

    points: Float[np.ndarray, "n N"]
    accepted: Float[np.ndarray, "n"]
    """Share of the proposals in a chain's second half that it accepted."""
    remembered: Float[np.ndarray, "n"]
    """prod (1 - s^2)^(1/2) over what it accepted: what is left of where it began, the optimum, were the cost quadratic.
    The variance of a draw is then too small by the square of it."""


def boltzmann_points(
    cost: Cost,
    optimum: Float[np.ndarray, "N"],
    curvature: Float[np.ndarray, "N N"],
    *,
    rationality: float,
    count: int,
    steps: int,
    rng: np.random.Generator,
) -> Chains:
    """`count` draws for beta = `rationality` [1/cost], each from a chain of `steps` proposals.

    `curvature` is symmetric and positive definite. Raises `InputError` for a rationality that is not positive, and an
    optimum that cannot be.
    """
    if not 0.0 < rationality < np.inf or steps < 2:
        raise InputError(f"rationality = {rationality}, steps = {steps}: give a positive number and at least 2 steps")
    factor = np.linalg.cholesky(rationality * curvature)
    x = np.repeat(optimum[None], count, axis=0)
    rest = cost(x)
    if not np.isfinite(rest).all():
        raise InputError(f"the optimum that deviations begin from costs {rest[0]}; give one that can be")
    size, rates, remembered = np.full(count, 0.5), np.zeros(count), np.ones(count)
    for step in range(steps):
        s = size[:, None]
        drawn = solve_triangular(factor.T, rng.standard_normal((len(factor), count))).T
        away = np.sqrt(1.0 - s**2) * (x - optimum) + s * drawn
        after = cost(optimum + away) - 0.5 * np.einsum("bi,ij,bj->b", away, curvature, away)
        chance = np.exp(np.minimum(0.0, rationality * (rest - after)))
        moves = rng.random(count) < chance
        x[moves], rest[moves] = optimum + away[moves], after[moves]
        remembered[moves] *= np.sqrt(1.0 - size[moves] ** 2)
        if step < steps // 2:
            size = np.minimum(1.0, size * np.exp((chance - ACCEPTED) / np.sqrt(step + 1.0)))
        else:
            rates += moves
    return Chains(x, rates / (steps - steps // 2), remembered)


class Demonstrator:
    """The cost of an arm's demonstrator and its curvature, as functions of the waypoints between start and goal."""

    def __init__(self, planner: ArmPlanner, weights: Float[np.ndarray, "K"], smoothness: float):
        self._planner = planner
        self._cost = TrajectoryCost(
            planner.arm,
            planner.scene.places,
            planner.features_used,
            weights,
            dt_s=planner.dt_s,
            smoothness=smoothness * rest_to_rest(planner.waypoints, planner.dt_s),
            shapes=table_of(planner.scene.shapes),
            margin_m=MARGIN_M,
            stiffness=STIFFNESS * max(1.0, float(np.linalg.norm(weights))),
        )

    def draws(
        self, optimum: Float[np.ndarray, "T D"], *, rationality: float, count: int, steps: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n T D"], Chains]:
        """Trajectories about an optimum, and the chains that they are the ends of; see `boltzmann_points`."""
        chains = boltzmann_points(
            lambda inner: self._costs(optimum, inner),
            optimum[1:-1].reshape(-1),
            self.curvature(optimum),
            rationality=rationality,
            count=count,
            steps=steps,
            rng=rng,
        )
        return self._whole(optimum, chains.points), chains

    def _whole(self, optimum: Float[np.ndarray, "T D"], inner: Float[np.ndarray, "B N"]) -> Float[np.ndarray, "B T D"]:
        x = np.repeat(optimum[None], len(inner), axis=0)
        x[:, 1:-1] = inner.reshape(len(inner), -1, optimum.shape[1])
        return x

    def _costs(self, optimum: Float[np.ndarray, "T D"], inner: Float[np.ndarray, "B N"]) -> Float[np.ndarray, "B"]:
        x, arm = self._whole(optimum, inner), self._planner.arm
        can_be = ((x >= arm.low) & (x <= arm.high)).all(axis=(1, 2)) & (self._planner.clearance(x) >= 0)
        return np.where(can_be, self._cost(x, np.arange(len(x)))[0], np.inf)

    def curvature(self, optimum: Float[np.ndarray, "T D"]) -> Float[np.ndarray, "N N"]:
        """H for the waypoints between start and goal, by central differences of the exact gradient; made positive."""
        inner = optimum[1:-1].reshape(-1)
        moved = np.concatenate([inner + side * STEP_RAD * np.eye(len(inner)) for side in (1.0, -1.0)])
        slopes = self._cost(self._whole(optimum, moved), np.arange(len(moved)))[1][:, 1:-1].reshape(len(moved), -1)
        difference = (slopes[: len(inner)] - slopes[len(inner) :]) / (2.0 * STEP_RAD)
        values, vectors = np.linalg.eigh(0.5 * (difference + difference.T))
        return (vectors * np.maximum(values, FLATTEST * values[-1])) @ vectors.T
