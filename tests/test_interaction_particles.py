import numpy as np
import pytest
import torch

from lfd.core.errors import InputError
from lfd.interaction.particles import ParticleBelief


def test_particles_follow_the_conjugate_gaussian(rng) -> None:
    """Prior N(0, 4 I), observations N(theta, 1): precision 1/4 + n, mean sum / (1/4 + n)."""
    belief = ParticleBelief.of(torch.from_numpy(2.0 * rng.normal(size=(20_000, 2))))
    truth, seen = np.array([1.5, -2.0]), []
    for _ in range(12):
        seen.append(truth + rng.normal(size=2))
        row = torch.from_numpy(seen[-1])
        belief = belief.updated(lambda theta, row=row: -0.5 * ((theta - row) ** 2).sum(1), rng)
    precision = 0.25 + len(seen)
    np.testing.assert_allclose(belief.mean.numpy(), np.sum(seen, axis=0) / precision, atol=0.02)
    np.testing.assert_allclose(belief.covariance.numpy(), np.eye(2) / precision, atol=0.012)
    assert belief.effective > 5000


def test_drawing_anew_keeps_mean_and_covariance(rng) -> None:
    particles = torch.from_numpy(rng.normal(size=(50_000, 2)) @ np.array([[1.0, 0.5], [0.0, 0.3]]))
    belief = ParticleBelief.of(particles).updated(lambda theta: 40.0 * theta[:, 0].clamp(max=1.0), rng)
    weights = torch.softmax(40.0 * particles[:, 0].clamp(max=1.0), 0)
    mean = weights @ particles
    covariance = (weights[:, None] * (particles - mean)).T @ (particles - mean)
    torch.testing.assert_close(belief.mean, mean, atol=0.01, rtol=0.0)
    torch.testing.assert_close(belief.covariance, covariance, atol=0.01, rtol=0.0)


def test_particles_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="particles have shape"):
        ParticleBelief.of(torch.empty(0, 2))
    with pytest.raises(InputError, match="finite"):
        ParticleBelief.of(torch.tensor([[torch.nan]]))
