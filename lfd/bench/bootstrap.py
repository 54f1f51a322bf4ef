"""Intervals by the percentiles of bootstrap samples (Efron 1979)."""

from typing import Any

import numpy as np
from jaxtyping import Float

RESAMPLES = 4000


def median_interval(values: Float[np.ndarray, "N"]) -> list[float]:
    """Median and the ends of its 95% interval by the percentiles of bootstrap samples."""
    drawn = values[_draws(len(values))]
    return [float(np.median(values)), *np.percentile(np.median(drawn, axis=1), [2.5, 97.5]).tolist()]


def ratio_interval(of: Float[np.ndarray, "N"], to: Float[np.ndarray, "N"], middle: Any) -> list[float]:
    """Ratio of the middles (`np.mean`, `np.median`) of paired values, with its bootstrap interval."""
    draws = _draws(len(of))
    ratios = middle(of[draws], axis=1) / middle(to[draws], axis=1)
    return [float(middle(of) / middle(to)), *np.percentile(ratios, [2.5, 97.5]).tolist()]


def in_words(values: list[float]) -> str:
    """A value, with the ends of its interval where they follow."""
    first, *ends = (f"{value:.3f}" for value in values)
    return f"{first} [{', '.join(ends)}]" if ends else first


def _draws(count: int) -> np.ndarray:
    """Which values are in each sample (RESAMPLES, count)."""
    return np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
