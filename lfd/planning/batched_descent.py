"""Minimisation of many smooth functions of the same kind at once, within bounds: L-BFGS in a given metric.

Every evaluation serves all rows that are still descending, and each row takes its own way: it either takes the step
tried, and turns to a new direction, or tries a shorter one next time. With M a metric (a positive definite estimate
of the Hessian), the two-loop recursion of L-BFGS (Nocedal and Wright, 2006, algorithm 7.4) starts from

    H_0 = (s.y / y.M^-1 y) M^-1

and bounds are kept by Bertsekas' two-metric projection (1982): components that stand at a bound which the gradient
pushes against are fixed, and the step x + alpha d is clipped. Steps are accepted by Armijo's rule alone, so a pair
(s, y) of negative curvature can come up; it is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lfd.planning.kinematics import compiled

MEMORY = 12
"""Pairs (s, y) that are remembered."""
ARMIJO = 1e-4
SHORTEST = 1e-9
"""Fraction of a direction below which a row gives up, after it tried without its memory."""


@dataclass(frozen=True)
class Minima:
    """Where the rows ended."""

    x: Float[np.ndarray, "B T D"]
    value: Float[np.ndarray, "B"]
    converged: Bool[np.ndarray, "B"]
    """Whether the decrease that the last direction promised was below the tolerance."""
    evaluations: int
    """How many times the function was called, each time for all rows then active."""


Function = Callable[[Float[np.ndarray, "A T D"], Int[np.ndarray, "A"]], tuple[np.ndarray, np.ndarray]]
"""Of the points tried and the rows that they belong to: values (A,) and gradients (A, T, D)."""


def minimise(
    function: Function,
    start: Float[np.ndarray, "B T D"],
    *,
    low: Float[np.ndarray, "D"],
    high: Float[np.ndarray, "D"],
    inverse_metric: Float[np.ndarray, "T T"],
    longest: float,
    tolerance: float,
    evaluations: int,
) -> Minima:
    """Local minima of `function` from each row of `start`, between `low` and `high`.

    The metric is the same for each of the D columns. No component of a direction is longer than `longest`. A row has
    converged when half the decrease that its direction promises, -g.d / 2, is below tolerance max(1, |value|).
    """
    rows, shape = np.arange(len(start)), start.shape
    low, high = np.array(low), np.array(high)  # numba compiles anew for read-only arrays
    x = np.clip(start, low, high)
    value, gradient = function(x, rows)
    steps, turns = np.zeros((len(x), MEMORY, *shape[1:])), np.zeros((len(x), MEMORY, *shape[1:]))
    pairs = np.zeros(len(x), dtype=np.int64)  # how many were put in so far
    direction, slope = _directions(rows, x, gradient, low, high, steps, turns, pairs, inverse_metric)
    fraction = np.ones(len(x))
    converged = np.zeros(len(x), dtype=bool)
    calls, active = 1, rows
    while True:
        converged[active] = -0.5 * slope[active] <= tolerance * np.maximum(1.0, np.abs(value[active]))
        active = active[~converged[active] & (fraction[active] >= SHORTEST)]
        if not len(active) or calls >= evaluations:
            return Minima(x, value, converged, calls)
        length = np.abs(direction[active]).max(axis=(1, 2))
        scale = fraction[active] * np.minimum(1.0, longest / length)
        trial = np.clip(x[active] + scale[:, None, None] * direction[active], low, high)
        tried, steeper = function(trial, active)
        calls += 1
        promised = np.einsum("atd,atd->a", gradient[active], trial - x[active])
        taken = tried <= value[active] + ARMIJO * promised
        moved, stayed = active[taken], active[~taken]
        _remember(moved, trial[taken] - x[moved], steeper[taken] - gradient[moved], steps, turns, pairs)
        x[moved], value[moved], gradient[moved], fraction[moved] = trial[taken], tried[taken], steeper[taken], 1.0
        # the minimum of the parabola through both values and the slope, within a tenth and a half
        excess = (tried - value[active] - promised)[~taken]
        parabola = -0.5 * promised[~taken] / np.where(excess > 0, excess, np.inf)
        fraction[stayed] *= np.clip(np.nan_to_num(parabola), 0.1, 0.5)
        lost = stayed[(fraction[stayed] < SHORTEST) & (pairs[stayed] > 0)]
        pairs[lost], fraction[lost] = 0, 1.0
        turned = np.concatenate([moved, lost])
        if len(turned):
            direction[turned], slope[turned] = _directions(
                turned, x, gradient, low, high, steps, turns, pairs, inverse_metric
            )


@compiled
def _remember(rows, step, turn, steps, turns, pairs):
    """Keep the pair (s, y) of each row, unless s.y is not clearly positive."""
    for i, row in enumerate(rows):
        inner = (step[i] * turn[i]).sum()
        if inner > 1e-10 * np.sqrt((step[i] ** 2).sum() * (turn[i] ** 2).sum()):
            slot = pairs[row] % MEMORY
            steps[row, slot], turns[row, slot] = step[i], turn[i]
            pairs[row] += 1


@compiled
def _apply(inverse_metric, vector, out):
    out[:] = 0.0
    for i in range(vector.shape[0]):
        for j in range(vector.shape[0]):
            weight = inverse_metric[i, j]
            for k in range(vector.shape[1]):
                out[i, k] += weight * vector[j, k]


@compiled
def _directions(rows, x, gradient, low, high, steps, turns, pairs, inverse_metric):
    """The direction of each of `rows`, and the slope along it; without memory where that is no way down."""
    count, n, d = len(rows), x.shape[1], x.shape[2]
    directions, slopes = np.zeros((count, n, d)), np.zeros(count)
    free, pull, scaled = np.empty((n, d)), np.empty((n, d)), np.empty((n, d))
    factor = np.empty(MEMORY)
    for i in range(count):
        row = rows[i]
        for t in range(n):
            for k in range(d):
                g = gradient[row, t, k]
                held = (x[row, t, k] <= low[k] and g > 0.0) or (x[row, t, k] >= high[k] and g < 0.0)
                free[t, k] = 0.0 if held else 1.0
        for attempt in range(2):
            if attempt == 1:
                pairs[row] = 0
            known = min(pairs[row], MEMORY)
            pull[:] = gradient[row] * free
            gamma = 1.0
            for back in range(known):  # newest first
                slot = (pairs[row] - 1 - back) % MEMORY
                s, y = steps[row, slot], turns[row, slot]
                factor[slot] = (s * pull).sum() / (s * y).sum()
                pull -= factor[slot] * y
                if back == 0:
                    _apply(inverse_metric, y, scaled)
                    gamma = (s * y).sum() / (y * scaled).sum()
            _apply(inverse_metric, pull, scaled)
            pull[:] = gamma * scaled
            for back in range(known - 1, -1, -1):
                slot = (pairs[row] - 1 - back) % MEMORY
                s, y = steps[row, slot], turns[row, slot]
                pull += (factor[slot] - (y * pull).sum() / (s * y).sum()) * s
            directions[i] = -pull * free
            slopes[i] = (directions[i] * gradient[row]).sum()
            if slopes[i] < 0.0:
                break
    return directions, slopes
