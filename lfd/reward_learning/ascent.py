"""L-BFGS for concave functions whose gradient is more exact than their value.

A log-likelihood of size 100 is known to about 1e-14, and near the top it differs from its maximum by gradient^2 /
curvature. Line searches that compare values therefore stall at gradients of 1e-6, where this one goes on: for a
concave function the slope along a line falls from positive to negative once, and finding that place needs slopes only.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Objective = Callable[[Float[np.ndarray, "K"]], tuple[float, Float[np.ndarray, "K"]]]
MEMORY = 20
STEEP, OVERSHOT = 0.9, 0.5
"""A step is taken when its slope is at most STEEP and at least -OVERSHOT times the slope at the start."""
ROUNDING = 1e-10
"""A value that is lower by no more than this share counts as unchanged."""
TRIES = 30
"""Evaluations of one line search."""
REACH, FARTHEST = 10.0, 1e6
"""A step goes at most REACH (1 + |x|) far; beyond FARTHEST there is taken to be no maximum."""


@dataclass(frozen=True)
class Ascent:
    """Where the ascent ended."""

    point: Float[np.ndarray, "K"]
    value: float
    gradient: Float[np.ndarray, "K"]
    iterations: int
    converged: bool
    """Whether the gradient's length is at most the tolerance; if not, steps ran out or there is no maximum."""


def maximise(objective: Objective, start: Float[np.ndarray, "K"], *, tolerance: float, max_iterations: int) -> Ascent:
    """Climb from `start` until |gradient|_2 <= `tolerance`, for at most `max_iterations` steps.

    `objective(x)` returns value and gradient of a concave function; a value that is not finite marks a point outside
    its domain, in which `start` must lie.
    """
    point = start
    value, gradient = objective(point)
    pairs: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=MEMORY)
    for iteration in range(max_iterations):
        if np.linalg.norm(gradient) <= tolerance:
            return Ascent(point, value, gradient, iteration, True)
        if np.linalg.norm(point) > FARTHEST:
            return Ascent(point, value, gradient, iteration, False)
        direction = _direction(gradient, pairs)
        if direction @ gradient <= 0:  # rounding: the memory is of no use any more
            pairs.clear()
            direction = gradient
        first = 1.0 if pairs else min(1.0, 1.0 / float(np.linalg.norm(gradient)))
        found = _search(objective, point, value, gradient, direction, first)
        if found is None:
            return Ascent(point, value, gradient, iteration, False)
        step, fall = found[0] - point, gradient - found[2]
        if step @ fall > 0:
            pairs.append((step, fall))
        point, value, gradient = found
    return Ascent(point, value, gradient, max_iterations, bool(np.linalg.norm(gradient) <= tolerance))


def _direction(gradient: Float[np.ndarray, "K"], pairs: deque[tuple[np.ndarray, np.ndarray]]) -> Float[np.ndarray, "K"]:
    """The two loops of L-BFGS (Nocedal and Wright 2006, algorithm 7.4), s steps and y falls of the gradient."""
    q, factors = gradient.copy(), []
    for s, y in reversed(pairs):
        factors.append((s @ q) / (s @ y))
        q -= factors[-1] * y
    if pairs:
        s, y = pairs[-1]
        q *= (s @ y) / (y @ y)
    for (s, y), factor in zip(pairs, reversed(factors), strict=True):
        q += (factor - (y @ q) / (s @ y)) * s
    return q


def _search(
    objective: Objective,
    point: Float[np.ndarray, "K"],
    value: float,
    gradient: Float[np.ndarray, "K"],
    direction: Float[np.ndarray, "K"],
    first: float,
) -> tuple[Float[np.ndarray, "K"], float, Float[np.ndarray, "K"]] | None:
    """A step along `direction` whose slope is nearly level, or the longest one; None where no step is any good.

    The slope is bracketed between `low`, where it is positive, and `high`, where it is negative or the domain ends.
    """
    slope = float(gradient @ direction)
    low, low_slope, high, high_slope, best = 0.0, slope, np.inf, -np.inf, None
    longest = REACH * (1.0 + float(np.linalg.norm(point))) / float(np.linalg.norm(direction))
    length = min(first, longest)
    for _ in range(TRIES):
        there = point + length * direction
        there_value, there_gradient = objective(there)
        there_slope = float(there_gradient @ direction)
        if not (np.isfinite(there_value) and np.isfinite(there_slope)):
            high, high_slope = length, -np.inf
        elif there_slope > STEEP * slope:
            low, low_slope, best = length, there_slope, (there, there_value, there_gradient)
            if length == longest:
                return best
        elif there_slope < -OVERSHOT * slope or there_value < value - ROUNDING * abs(value):
            high, high_slope = length, there_slope
        else:
            return there, there_value, there_gradient
        if np.isinf(high):
            length = min(4.0 * length, longest)
        else:
            share = low_slope / (low_slope - high_slope) if np.isfinite(high_slope) else 0.5
            length = low + min(max(share, 0.1), 0.9) * (high - low)
    return best
