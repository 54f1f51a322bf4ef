"""Apprenticeship learning, Algorithm 2 of the chapter (Abbeel and Ng 2004)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError
from lfd.reward_learning.hull import max_margin
from lfd.rewards.checked_arrays import finite_array

NO_PROGRESS = 1e-10
"""A new policy that beats the old ones by less than this share of the largest number leaves the margin as it is."""


@dataclass(frozen=True)
class Apprenticeship:
    """What Algorithm 2 found. Policy 0 is the initial one, policy i the optimal one for row i - 1 of `planned_for`."""

    weights: Float[np.ndarray, "K"]
    """w of the last solution of (10.5); 0 when the expert lies in the hull of the policies."""
    margins: Float[np.ndarray, "M"]
    """t_i of every iteration, never growing: how far the best mixture is from the expert."""
    mus: Float[np.ndarray, "M K"]
    """mu of every policy."""
    planned_for: Float[np.ndarray, "M_1 K"]
    """The weights that policies 1, 2, ... are optimal for."""
    mixture: Float[np.ndarray, "M"]
    """Draw one of the policies with these probabilities at the start of an episode: the mu of that is within the last
    margin of mu_E. This is what the stopping rule certifies."""
    best: int
    """The single policy whose mu is nearest to mu_E. The stopping rule does not certify it."""
    best_distance: float
    """|mu_E - mu_best|, at least the last margin."""
    converged: bool
    """Whether the last margin is at most the tolerance. If not, either the iterations ran out or the expert is out of
    reach: the last plan improved on no policy, and the margin is mu_E's distance to everything that can be planned."""


def apprenticeship(
    mu_expert: Shaped[np.ndarray, "..."],
    plan: Callable[[Float[np.ndarray, "K"]], Shaped[np.ndarray, "..."]],
    *,
    initial: Shaped[np.ndarray, "..."],
    tolerance: float | int,
    max_iterations: int,
) -> Apprenticeship:
    """Plan for the weights under which the expert beats all policies so far, until t_i <= `tolerance`.

    `plan(weights)` returns mu (K,) of an optimal policy for R = w^T phi, `initial` is mu(pi_0) of any policy. An
    iteration solves (10.5) once. Raises `InputError` for arrays of other shapes and without an iteration.
    """
    expert = finite_array("mu_expert", mu_expert, ("K",))
    mus = [finite_array("initial", initial, expert.shape)]
    planned_for: list[Float[np.ndarray, "K"]] = []
    margins: list[float] = []
    if max_iterations < 1:
        raise InputError(f"max_iterations = {max_iterations}: at least one is needed")
    while True:
        solution = max_margin(expert, np.array(mus))
        margins.append(solution.margin)
        if solution.margin <= tolerance or len(margins) == max_iterations:
            break
        mu = finite_array("mu of plan(weights)", plan(solution.weights), expert.shape)
        gain = solution.weights @ mu - max(float(solution.weights @ old) for old in mus)
        if gain <= NO_PROGRESS * max(np.abs(mu).max(), np.abs(mus).max()):
            break
        mus.append(mu)
        planned_for.append(solution.weights)
    distances = np.linalg.norm(np.array(mus) - expert, axis=1)
    return Apprenticeship(
        weights=solution.weights,
        margins=np.array(margins),
        mus=np.array(mus),
        planned_for=np.array(planned_for).reshape(-1, len(expert)),
        mixture=solution.mixture,
        best=int(distances.argmin()),
        best_distance=float(distances.min()),
        converged=solution.margin <= tolerance,
    )
