"""The Wilson score interval of a success rate."""

from math import sqrt

Z_95 = 1.959963984540054
"""97.5% quantile of the standard normal distribution."""


def wilson_interval(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Interval for a proportion, by default of 95% coverage.

    (p + z^2/2n +- z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n),  p = successes / n

    (Wilson 1927, "Probable Inference, the Law of Succession, and Statistical Inference"). Unlike the normal
    approximation it keeps a width when every trial succeeds.
    """
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(f"{successes} successes in {trials} trials")
    p, n = successes / trials, trials
    centre = p + z * z / (2 * n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return max(0.0, min(p, (centre - half) / scale)), min(1.0, max(p, (centre + half) / scale))  # rounding
