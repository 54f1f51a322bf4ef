"""Compounding error: what an episode costs a cloned policy and one from DAgger, against the episode's length.

On the tightrope the numbers are exact. With epsilon the learners' error on the expert's states,

    cloned    J_T = sum_t=1^T 1 - (1 - epsilon)^t                     ~ epsilon T^2 / 2   while epsilon T is small
    DAgger    J_T = sum_t=1^T epsilon (1 - (-epsilon)^t) / (1 + epsilon)  ~ epsilon T

as Ross and Bagnell's bounds say (2010, Theorem 2.1: epsilon T^2; 2011, Theorem 2.2: u epsilon T, where u, what an error
costs until it is made good, is 1 here). On Lift they are measured (`lfd.bench.stretched_lift`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.bench.stretched_lift import Setting, Side, Stretched, bench_lift
from lfd.bench.tightrope import clone, dagger, error_rate, expected_cost, mixture
from lfd.core.protocols import Progress, silent
from lfd.run.control import beta_schedule

CLONED, AGGREGATED = "C3", "C0"
"""Colours of the two learners."""


@dataclass(frozen=True, kw_only=True)
class CompoundingBench:
    """What one run computed and measured."""

    epsilon: float
    """Probability of the learners' error on the rope, where the expert's episodes are."""
    horizons: tuple[int, ...]
    """Lengths of episodes on the tightrope [steps]."""
    cloned: tuple[float, ...]
    """Expected cost of the cloned policy at each."""
    dagger: tuple[float, ...]
    """Expected cost of DAgger's policy at each."""
    slopes: dict[str, float]
    """Slope of log cost against log length over all horizons, by learner and problem."""
    lift: tuple[Stretched, ...]
    """Lift at each speed of the expert."""


def bench_compounding(
    *,
    epsilon: float,
    horizons: Sequence[int],
    rounds: int,
    lift: Setting,
    speeds: Sequence[float],
    seeds: Sequence[int],
    progress: Progress = silent,
) -> CompoundingBench:
    """Compute the tightrope at each of some horizons, and measure Lift at each of some speeds over some seeds."""
    betas = beta_schedule("first", rounds, rate=0.0)
    cloned, aggregated = ([], [])
    for horizon in horizons:
        for learner, costs in ((clone(epsilon, horizon), cloned), (dagger(epsilon, horizon, betas), aggregated)):
            costs.append(expected_cost(mixture(learner, 0.0), epsilon, horizon))
            assert np.isclose(error_rate(learner, epsilon), epsilon)
    measured = bench_lift(lift, speeds=speeds, seeds=seeds, progress=progress)
    lengths, sides = [row.length for row in measured], _sides(measured)
    slopes = {
        "tightrope, cloned": slope(horizons, cloned),
        "tightrope, DAgger": slope(horizons, aggregated),
        "Lift, cloned": slope(lengths, [side.cost for side in sides[0]]),
        "Lift, DAgger": slope(lengths, [side.cost for side in sides[1]]),
    }
    return CompoundingBench(
        epsilon=epsilon,
        horizons=tuple(horizons),
        cloned=tuple(cloned),
        dagger=tuple(aggregated),
        slopes={name: round(value, 3) for name, value in slopes.items()},
        lift=tuple(measured),
    )


def slope(lengths: Sequence[float], costs: Sequence[float]) -> float:
    """The power p of the least-squares fit log J = p log T + c; NaN where a cost is 0."""
    if min(costs) <= 0:
        return float("nan")
    return float(np.polyfit(np.log(lengths), np.log(costs), 1)[0])


def _sides(lift: Sequence[Stretched]) -> tuple[list[Side], list[Side]]:
    """The cloned side of every row, and DAgger's."""
    return [row.cloned for row in lift], [row.dagger for row in lift]


def rows_of(measured: CompoundingBench) -> dict[str, str]:
    """The lines of a results page."""
    rows = {"error on the expert's states of the tightrope": f"{measured.epsilon:g}"}
    rows |= {f"slope of log cost against log T: {name}": f"{value:.2f}" for name, value in measured.slopes.items()}
    for horizon, cloned, aggregated in zip(measured.horizons, measured.cloned, measured.dagger, strict=True):
        rows[f"tightrope, T = {horizon}"] = f"expected cost {cloned:.3g} cloned, {aggregated:.3g} with DAgger"
    for row in measured.lift:
        said = [
            f"{name} {side.cost:.1f} errors (seeds {min(side.costs):.1f} to {max(side.costs):.1f}), "
            f"{side.solved} of {row.episodes} solved"
            for name, side in (("cloned", row.cloned), ("DAgger", row.dagger))
        ]
        what = f"Lift, expert at {row.speed:.0%} of its speed: {row.length:.0f} steps, {row.cloned.labels} labels"
        rows[what] = "; ".join(said)
    return rows


def plot(measured: CompoundingBench, path: Path) -> None:
    """Cost against length, both logarithmic, with triangles of slope 1 and 2."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    rope, lift = figure.subplots(1, 2)
    lengths = np.array(measured.horizons, dtype=float)
    _curves(rope, lengths, measured.cloned, measured.dagger, "tightrope, exact", "expected cost of an episode")
    for costs, power in ((measured.cloned, 2), (measured.dagger, 1)):
        _triangle(rope, lengths, np.array(costs), power)
    lengths = np.array([row.length for row in measured.lift])
    cloned, aggregated = ([side.cost for side in sides] for sides in _sides(measured.lift))
    _curves(lift, lengths, cloned, aggregated, "Lift with slower experts, measured", "errors in an episode")
    for sides, colour in zip(_sides(measured.lift), (CLONED, AGGREGATED), strict=True):
        for length, side in zip(lengths, sides, strict=True):
            lift.plot([length] * len(side.costs), side.costs, ".", color=colour, alpha=0.4)
    figure.savefig(path, dpi=150)


def _curves(
    axes: Any, lengths: Float[np.ndarray, "H"], cloned: Sequence[float], aggregated: Sequence[float], title: str, y: str
) -> None:
    axes.loglog(lengths, cloned, "o-", color=CLONED, label="behaviour cloning")
    axes.loglog(lengths, aggregated, "s-", color=AGGREGATED, label="DAgger")
    axes.set(xlabel="steps of an episode, T", ylabel=y, title=title)
    axes.grid(alpha=0.3, which="major")
    axes.legend(frameon=False)


def _triangle(axes: Any, lengths: Float[np.ndarray, "H"], costs: Float[np.ndarray, "H"], power: int) -> None:
    """A right triangle below the curve, over a factor of 2 in T."""
    middle = len(lengths) // 2
    left, low = lengths[middle], 0.45 * costs[middle]
    corners = np.array([[left, low], [2 * left, low], [2 * left, low * 2**power], [left, low]])
    axes.plot(*corners.T, color="0.4", linewidth=1)
    axes.annotate(f"{power}", (2.1 * left, low * 2 ** (power / 2)), color="0.4", va="center")
