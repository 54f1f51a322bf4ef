"""The Laplace approximation of maximum entropy inverse RL (Levine and Koltun 2012), local to each demonstration.

    p(u) = exp(r(u)) / integral exp(r(u')) du',    r(u') ~ r + (u' - u)^T g + (u' - u)^T H (u' - u) / 2

    log p(u) ~ g^T H^-1 g / 2 + log det(-H) / 2 - n/2 log 2 pi

with gradient g and Hessian H of the reward at the demonstrated controls u. Exact for quadratic rewards. The expert only
needs to be a local optimum: nothing is said about trajectories far away, so a second optimum is not seen (with two
equal ones the approximation is off by log 2), and the reward must be strictly concave at the demonstration.

For r = w^T f and A(w) = -sum_k w_k H_k, linear in w, the approximation is concave in w where A is positive definite: a
matrix-fractional function with a minus sign, and a log det.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Shaped
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor
from torch.autograd.functional import hessian, jacobian

from lfd.core.errors import InputError
from lfd.reward_learning.ascent import maximise
from lfd.reward_learning.failures import NotConcave
from lfd.rewards.checked_arrays import finite_array


@dataclass(frozen=True)
class LaplaceMaxEnt:
    """Result of `maxent_laplace`."""

    weights: Float[np.ndarray, "K"]
    """w."""
    log_likelihood: float
    """sum_i log p(u_i), approximated, without the regulariser."""
    gradient: Float[np.ndarray, "K"]
    """Of what was maximised, at the end."""
    converged: bool
    """Whether |gradient|_2 <= tolerance."""
    iterations: int
    """Steps of L-BFGS."""


def laplace_log_likelihood(reward: Callable[[Tensor], Tensor], controls: Shaped[np.ndarray, "..."]) -> float:
    """log p(u) of the demonstrated `controls` (n,) under exp(r); `reward` maps a float64 tensor (n,) to a scalar.

    All controls of a trajectory are one vector; the dynamics are inside the reward.

    Raises `NotConcave` where -H is not positive definite, `InputError` where a derivative is not finite.
    """
    point = torch.from_numpy(finite_array("controls", controls, ("n",)).copy())

    def scalar(u: Tensor) -> Tensor:
        return reward(u).reshape(())

    gradient = finite_array("gradient of the reward", np.asarray(jacobian(scalar, point)), point.shape)
    curvature = finite_array("Hessian of the reward", np.asarray(hessian(scalar, point)), (*point.shape, *point.shape))
    try:
        return _log_density(gradient, -curvature)[0]
    except np.linalg.LinAlgError as error:
        largest = float(np.linalg.eigvalsh(0.5 * (curvature + curvature.T)).max())
        raise NotConcave(
            f"the Hessian of the reward has the eigenvalue {largest:.3g} >= 0 at the demonstration: it is no strict "
            "local maximum of this reward, whose exp then has no Gaussian approximation there; change the weights, "
            "or add a feature that costs in every direction, such as the squared controls"
        ) from error


def maxent_laplace(
    features: Callable[[Tensor], Tensor],
    demonstrations: Sequence[Shaped[np.ndarray, "..."]],
    *,
    initial: Shaped[np.ndarray, "..."],
    l2: float | int,
    tolerance: float | int,
    max_iterations: int,
) -> LaplaceMaxEnt:
    """max_w sum_i log p(u_i; r = w^T f) - l2/2 |w|^2, from `initial` (K,), where all rewards must be concave.

    `features` maps controls (n_i,) to f(u) (K,). Derivatives of f are taken once; steps cost linear algebra alone.

    Raises `NotConcave` naming the demonstration where `initial` is no start, `InputError` without a demonstration.
    """
    start = finite_array("initial", initial, ("K",))
    if len(demonstrations) == 0:
        raise InputError("demonstrations is empty: give the controls of at least one")
    if not 0.0 <= l2 < np.inf:
        raise InputError(f"l2 = {l2}: give a number that is not negative; 0 is no regulariser")
    pairs = [_derivatives(features, controls, len(start), i) for i, controls in enumerate(demonstrations)]
    for i, (_, curvatures) in enumerate(pairs):
        largest = float(np.linalg.eigvalsh(np.tensordot(start, curvatures, 1)).max())
        if largest >= 0:
            raise NotConcave(
                f"demonstration {i}: with the initial weights the Hessian of the reward has the eigenvalue "
                f"{largest:.3g} >= 0; start from weights under which every demonstration is a strict local maximum"
            )

    def objective(weights: Float[np.ndarray, "K"]) -> tuple[float, Float[np.ndarray, "K"]]:
        value, slope = -0.5 * l2 * float(weights @ weights), -l2 * weights
        for jacobians, curvatures in pairs:
            try:
                density, (towards, inverse) = _log_density(weights @ jacobians, -np.tensordot(weights, curvatures, 1))
            except np.linalg.LinAlgError:  # outside the domain; the line search turns back
                return -np.inf, slope
            value += density
            # d/dw_k: -J_k y - y^T H_k y / 2 - tr(A^-1 H_k) / 2,  y = A^-1 g
            slope = (
                slope - jacobians @ towards - 0.5 * np.tensordot(curvatures, np.outer(towards, towards) + inverse, 2)
            )
        return value, slope

    found = maximise(objective, start, tolerance=tolerance, max_iterations=max_iterations)
    likelihood = found.value + 0.5 * l2 * float(found.point @ found.point)
    return LaplaceMaxEnt(found.point, likelihood, found.gradient, found.converged, found.iterations)


def _log_density(
    gradient: Float[np.ndarray, "n"], bend: Float[np.ndarray, "n n"]
) -> tuple[float, tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n n"]]]:
    """-g^T A^-1 g / 2 + log det A / 2 - n/2 log 2 pi for A = -H, and A^-1 g and A^-1. LinAlgError unless A > 0."""
    factor = cho_factor(0.5 * (bend + bend.T), lower=True)
    inverse = cho_solve(factor, np.eye(len(gradient)))
    towards = cho_solve(factor, gradient)
    log_determinant = 2.0 * float(np.log(np.diag(factor[0])).sum())
    density = -0.5 * float(gradient @ towards) + 0.5 * log_determinant - 0.5 * len(gradient) * np.log(2 * np.pi)
    return float(density), (towards, inverse)


def _derivatives(
    features: Callable[[Tensor], Tensor], controls: Shaped[np.ndarray, "..."], count: int, index: int
) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, "K n n"]]:
    """Jacobian and Hessians of f at the controls of demonstration `index`."""
    point = torch.from_numpy(finite_array(f"controls of demonstration {index}", controls, ("n",)).copy())
    jacobians = np.asarray(jacobian(features, point))
    curvatures = np.stack([np.asarray(hessian(lambda u, k=k: features(u)[k], point)) for k in range(count)])
    finite_array(f"Jacobian of the features of demonstration {index}", jacobians, (count, len(point)))
    finite_array(f"Hessians of the features of demonstration {index}", curvatures, (count, len(point), len(point)))
    return jacobians, curvatures
