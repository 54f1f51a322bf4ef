"""A belief over a theta that is continuous: weighted particles, drawn anew when few of them carry the weight.

    w_i <- w_i p(u_H | x, u_R, theta_i) / eta;    where 1 / sum w^2 < N / 2: systematic resampling, then
    theta_i <- a theta_i + (1 - a) mean + sqrt(1 - a^2) chol(covariance) eps,    a = 0.98 (Liu and West 2001)

The last keeps mean and covariance in expectation, and lets particles go where none were.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.errors import InputError
from lfd.interaction.intent import IntentBelief

SHRINK = 0.98
JITTER = 1e-12
"""Variance that is added where particles have none."""


@dataclass(frozen=True)
class ParticleBelief:
    """N particles in D dimensions with their weights."""

    weighted: IntentBelief
    """Particles (N, D), as thetas."""

    @classmethod
    def of(cls, particles: Float[Tensor, "N D"]) -> "ParticleBelief":
        """Particles of equal weight. Raises `InputError` for another shape, none, or numbers that are not finite."""
        given = torch.as_tensor(particles, dtype=torch.float64)
        if given.ndim != 2 or 0 in given.shape or not torch.isfinite(given).all():
            raise InputError(
                f"particles have shape {tuple(given.shape)}; give (N, D) finite numbers, N and D at least 1"
            )
        return cls(IntentBelief(given, torch.ones(len(given))))

    @property
    def effective(self) -> float:
        """1 / sum w^2: as many particles of equal weight would be as good."""
        return float(1.0 / (self.weighted.probabilities**2).sum())

    @property
    def mean(self) -> Float[Tensor, "D"]:
        """Mean of theta."""
        return self.weighted.mean

    @property
    def covariance(self) -> Float[Tensor, "D D"]:
        """Covariance of theta."""
        away = self.weighted.thetas - self.mean
        return (self.weighted.probabilities[:, None] * away).T @ away

    def updated(
        self, log_likelihood: Callable[[Float[Tensor, "N D"]], Float[Tensor, "N"]], rng: np.random.Generator
    ) -> "ParticleBelief":
        """The belief after an observation, whose log likelihood is given for each theta.

        Raises what `IntentBelief.updated` raises.
        """
        after = ParticleBelief(self.weighted.updated(log_likelihood(self.weighted.thetas)))
        if after.effective >= len(after.weighted.thetas) / 2.0:
            return after
        return after._drawn_anew(rng)

    def _drawn_anew(self, rng: np.random.Generator) -> "ParticleBelief":
        count, size = self.weighted.thetas.shape
        places = (rng.random() + np.arange(count)) / count
        ends = torch.cumsum(self.weighted.probabilities, 0)
        chosen = torch.clamp(torch.searchsorted(ends, torch.from_numpy(places)), max=count - 1)
        root = torch.linalg.cholesky(self.covariance + JITTER * torch.eye(size, dtype=torch.float64))
        noise = torch.from_numpy(rng.normal(size=(count, size))) @ root.T
        kept = SHRINK * self.weighted.thetas[chosen] + (1.0 - SHRINK) * self.mean
        return ParticleBelief.of(kept + np.sqrt(1.0 - SHRINK**2) * noise)
