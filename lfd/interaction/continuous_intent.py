"""log p(u_H | u_R, theta) for controls that are numbers: R_H less its normaliser, log of the integral of exp R_H over
u_H.

    quadrature    Gauss-Legendre points over bounds; for smooth rewards, one to three controls
    laplace       R_H(u*) + m/2 log 2 pi - 1/2 log det(-H) at u* = argmax R_H; exact for quadratic rewards
    samples       log of the mean of exp R_H / q over samples of q; any number of controls, with a standard error
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import hessian, vmap

from lfd.core.errors import InputError
from lfd.interaction.responses import Bounds, best_response, limits

OwnReward = Callable[[Tensor], Tensor]
"""u_human to a scalar: R_H with state, u_robot and theta bound."""


class Estimate(NamedTuple):
    """A log likelihood from samples."""

    value: float
    standard_error: float
    """Of the log normaliser, to first order."""
    effective_samples: float


def log_likelihood_quadrature(
    reward: OwnReward, u_human: Float[Tensor, "m"], *, bounds: Bounds, points: int = 64
) -> float:
    """log p(u_human) with u_H in a box. Raises `InputError` for bounds that are not finite or more than 3 controls."""
    low, high = limits(bounds, u_human)
    if not (torch.isfinite(low).all() and torch.isfinite(high).all()) or not 1 <= len(low) <= 3:
        raise InputError(
            f"quadrature needs 1 to 3 controls within finite bounds; these are {low.tolist()}, {high.tolist()}"
        )
    nodes, weights = (torch.from_numpy(each) for each in np.polynomial.legendre.leggauss(points))
    axes = [low[i] + (high[i] - low[i]) * (nodes + 1.0) / 2.0 for i in range(len(low))]
    scales = [torch.log(weights * (high[i] - low[i]) / 2.0) for i in range(len(low))]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(low))
    logs = torch.stack(torch.meshgrid(*scales, indexing="ij"), dim=-1).sum(dim=-1).reshape(-1)
    return float(reward(u_human) - torch.logsumexp(vmap(reward)(grid) + logs, 0))


def log_likelihood_laplace(
    reward: OwnReward, u_human: Float[Tensor, "m"], *, init: Float[Tensor, "m"] | None = None
) -> float:
    """log p(u_human) with the integral's Gaussian approximation at the maximum of R_H near `init` (default: `u_human`).

    Raises what `best_response` raises.
    """
    nobody = torch.zeros(0, dtype=torch.float64)
    top = best_response(lambda _, u: reward(u), nobody, u_human if init is None else init)
    log_det = torch.linalg.slogdet(-hessian(reward)(top))[1]
    log_integral = reward(top) + 0.5 * len(top) * np.log(2.0 * np.pi) - 0.5 * log_det
    return float(reward(u_human) - log_integral)


def log_likelihood_samples(
    reward: OwnReward, u_human: Float[Tensor, "m"], samples: Float[Tensor, "N m"], log_density: Float[Tensor, "N"]
) -> Estimate:
    """log p(u_human), with importance samples of a density that is positive wherever exp R_H matters."""
    ratios = vmap(reward)(samples) - log_density
    count = len(samples)
    log_integral = torch.logsumexp(ratios, 0) - np.log(count)
    relative = torch.exp(ratios - log_integral)  # mean 1
    error = float(relative.std() / np.sqrt(count))
    return Estimate(float(reward(u_human) - log_integral), error, float(count**2 / (relative**2).sum()))
