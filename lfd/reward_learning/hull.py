"""Program (10.5): the weights under which the expert beats every candidate by the largest margin.

    max_{w,t} t   s.t.   w^T mu_E >= w^T mu_i + t  for all i,   |w|_2 <= 1                                    (10.5)

(the chapter prints it without its objective). Its dual is the projection of mu_E on the convex hull of the candidates:

    t = min_lambda |mu_E - sum_i lambda_i mu_i|,   lambda >= 0,  sum_i lambda_i = 1,
    w = (mu_E - sum_i lambda_i mu_i) / t

so t is the distance of mu_E to the hull, and lambda is the mixture of policies that comes nearest to it. A small t
certifies that mixture; the best single candidate can be far away. With d_i = mu_i - mu_E the projection is

    min_{x >= 0} |sum_i x_i d_i|^2 + (sum_i x_i - 1)^2,   lambda = x / sum_i x_i

since for x = s lambda the best s leaves |sum lambda_i d_i|^2 / (1 + |sum lambda_i d_i|^2), which grows with the
distance. This is a non-negative least-squares problem, which an active set solves exactly (Lawson and Hanson 1974); it
needs no warm start, 500 candidates of 50 features taking about a millisecond.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.optimize import nnls

from lfd.core.errors import InputError
from lfd.reward_learning.failures import SolverFailed
from lfd.rewards.checked_arrays import finite_array

ZERO_MARGIN = 1e-12
"""Distances up to this share of the largest number given are rounding errors of mu: they count as 0."""
CERTIFICATE = 1e-8
"""By how much a candidate may miss the margin, as a share of the largest number given, before it is a failure."""
ROUNDING = 1e-14
"""Share of the largest number's square up to which products of differences are rounding errors."""


@dataclass(frozen=True)
class MaxMargin:
    """Solution of (10.5)."""

    weights: Float[np.ndarray, "K"]
    """w, of length 1; 0 when mu_E lies in the hull, where no direction separates it from the candidates."""
    margin: float
    """t >= 0, the distance of mu_E to the hull; 0 means that `mixture` matches the expert exactly, not that nothing was
    found. On the hull's boundary other w of length <= 1 reach t = 0 as well; inside, w = 0 alone does."""
    mixture: Float[np.ndarray, "M"]
    """Convex weights lambda of the candidates whose mu is nearest to mu_E."""


def max_margin(mu_expert: Shaped[np.ndarray, "..."], mu_candidates: Shaped[np.ndarray, "..."]) -> MaxMargin:
    """Solve (10.5) for `mu_expert` (K,) and `mu_candidates` (M, K).

    Raises `InputError` for other shapes, numbers that are not finite and when there is no candidate, `SolverFailed`
    when the solution does not satisfy the optimality conditions.
    """
    candidates = finite_array("mu_candidates", mu_candidates, ("M", "K"))
    expert = finite_array("mu_expert", mu_expert, (candidates.shape[1],))
    if len(candidates) == 0:
        raise InputError("mu_candidates has no row: give the feature expectations of at least one policy")
    away = candidates - expert
    scale = max(float(np.abs(candidates).max(initial=0.0)), float(np.abs(expert).max(initial=0.0)))
    mixture = _nearest(away, ROUNDING * scale**2)
    nearest = mixture @ away
    margin = float(np.linalg.norm(nearest))
    if margin <= ZERO_MARGIN * scale:
        return MaxMargin(weights=np.zeros_like(expert), margin=0.0, mixture=mixture)
    return MaxMargin(weights=-nearest / margin, margin=margin, mixture=mixture)


def _nearest(away: Float[np.ndarray, "M K"], rounding: float) -> Float[np.ndarray, "M"]:
    """lambda of the point p of the hull of `away` that is nearest to 0: no d_i . p is below |p|^2, up to `rounding`."""
    scale = np.abs(away).max(initial=0.0) or 1.0
    rows = np.vstack([away.T / scale, np.ones(len(away))])
    try:
        x, _ = nnls(rows, np.append(np.zeros(away.shape[1]), 1.0), maxiter=10 * sum(rows.shape))
    except RuntimeError as error:
        raise SolverFailed(f"scipy.optimize.nnls on {len(away)} candidates: {error}") from error
    # Once in some thousand problems nnls has the right candidates with wrong weights: then these are solved for anew.
    for mixture in (x / x.sum(), _on_face(away, x > 0)):
        nearest = mixture @ away
        missed = float(nearest @ nearest - (away @ nearest).min())
        if mixture.min() >= 0 and missed <= max(CERTIFICATE * scale * float(np.linalg.norm(nearest)), rounding):
            return mixture
    raise SolverFailed(f"scipy.optimize.nnls on {len(away)} candidates ended at a point that is not the nearest")


def _on_face(away: Float[np.ndarray, "M K"], face: Bool[np.ndarray, "M"]) -> Float[np.ndarray, "M"]:
    """lambda, of sum 1, of the point nearest to 0 in the plane through the chosen rows."""
    corner, *others = away[face]
    sides = np.reshape(others, (-1, away.shape[1])) - corner
    shares = np.linalg.lstsq(sides.T, -corner, rcond=None)[0]
    mixture = np.zeros(len(away))
    mixture[face] = np.append(1.0 - shares.sum(), shares)
    return mixture
