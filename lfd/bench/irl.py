"""`lfd bench irl`: three methods of inverse RL against the number of demonstrations; and what cannot be told.

On grids, for each problem, expert and number of demonstrations, over several seeds (each with a world, reward and
demonstrations of its own):

- **EVD**, expected value difference: what the optimal policy of the learned weights falls short of under the true
  reward, (V* - V) / (V* - V_uniform); and the same for the policies that the method hands over;
- **feature gap** |mu_E - mu(pi)| / |mu_E - mu(uniform)|, with the expert's exact mu_E and what is handed over as pi;
- CPU time.

`lfd.bench.irl_arm` measures them on an arm, `lfd.bench.irl_peer` compares with imitation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from lfd.bench import irl_arm, irl_peer
from lfd.bench.irl_methods import APPRENTICESHIP, ENTROPY, METHODS, PRIOR, Learned, evidence_of, learn
from lfd.bench.irl_problems import PROBLEMS, SOFT, Problem, make_problem, uniform_policy
from lfd.bench.peers.process import PeerError, peer_python, peers_folder
from lfd.core.protocols import Bar, Progress, silent
from lfd.planning import TabularMDP
from lfd.reward_learning import identifiable_directions

COLOURS = dict(zip(METHODS, ("C1", "C2", "C0"), strict=True))
FAR = 10.0
"""How far along a direction that is not identifiable the weights are moved, to show that nothing happens."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """One method on one set of demonstrations."""

    weights_evd: float
    """EVD of the optimal policy of the learned weights."""
    policy_evd: float
    """EVD of what the method hands over."""
    gap: float
    """Relative feature gap of what the method hands over."""
    seconds: float
    """CPU time [s]."""
    converged: bool


@dataclass(frozen=True, kw_only=True)
class Ambiguity:
    """What demonstrations can tell in one world."""

    features: int
    """K."""
    identified: int
    """Directions of w that some number of demonstrations tells."""
    told: int
    """Those that the most demonstrations here tell to a standard error below the prior's, 1 nat."""
    unchanged: float
    """Largest change of an action's probability when w moves by `FAR` along each of the others; 0 if there is none."""


@dataclass(frozen=True, kw_only=True)
class IrlBench:
    """What one run measured."""

    size: int
    """Cells along a side."""
    counts: tuple[int, ...]
    """Numbers of demonstrations."""
    seeds: tuple[int, ...]
    points: dict[str, dict[str, dict[str, list[list[Point]]]]]
    """Problem to expert to method to its points at every count, each with one for every seed."""
    experts: dict[str, dict[str, list[float]]]
    """Problem to expert to its own EVD in every seed."""
    ambiguity: dict[str, list[Ambiguity]]
    """Problem to what can be told in every seed's world."""
    arm: irl_arm.ArmBench
    """The same on an arm."""
    beside: tuple[irl_peer.Beside, ...]
    """Grids on which imitation was compared with."""
    missing: str
    """Why imitation was left out; empty when it was not."""


def bench_irl(
    *,
    size: int,
    counts: Sequence[int],
    seeds: Sequence[int],
    arm: tuple[Sequence[int], int, Sequence[int]],
    grids: int,
    peer_size: int,
    progress: Progress = silent,
) -> IrlBench:
    """Measure the methods on grids of `size` x `size` cells, and imitation on `grids` of `peer_size` (0: on none).

    `arm` are the numbers of demonstrations, the number of scenes held out and the seeds of `bench_arm`.
    """
    points: dict[str, Any] = {name: {} for name in PROBLEMS}
    experts: dict[str, Any] = {name: {} for name in PROBLEMS}
    ambiguity: dict[str, list[Ambiguity]] = {name: [] for name in PROBLEMS}
    with progress("bench irl", len(PROBLEMS) * len(seeds) + len(arm[2]) + grids) as bar:
        for number, name in enumerate(PROBLEMS):
            for seed in seeds:
                rng = np.random.default_rng((seed, number))
                problem = make_problem(name, size=size, rng=rng)
                last = _one_world(problem, counts, rng, points[name], experts[name])
                ambiguity[name].append(ambiguity_of(problem.mdp, last.weights, demonstrations=counts[-1]))
                bar.advance(note=f"{name}, seed {seed}")
        on_arm = irl_arm.bench_arm(counts=arm[0], held_out=arm[1], seeds=arm[2], bar=bar)
        beside, missing = _beside(grids, peer_size, seeds[0], bar)
    return IrlBench(
        size=size,
        counts=tuple(counts),
        seeds=tuple(seeds),
        points=points,
        experts=experts,
        ambiguity=ambiguity,
        arm=on_arm,
        beside=beside,
        missing=missing,
    )


def _one_world(
    problem: Problem, counts: Sequence[int], rng: np.random.Generator, points: dict[str, Any], own: dict[str, Any]
) -> Learned:
    """All methods in one world, into `points` and `own`; returns maximum entropy from the most of the soft expert."""
    kept = None
    for expert, policy in problem.experts.items():
        own.setdefault(expert, []).append(problem.loss(_value(problem, policy)))
        for place, count in enumerate(counts):
            evidence = evidence_of(problem.mdp, problem.mdp.sample(policy, count, rng))
            for method in METHODS:
                learned = learn(method, evidence)
                rows = points.setdefault(expert, {}).setdefault(method, [[] for _ in counts])
                rows[place].append(point_of(problem, policy, learned))
                kept = learned if (expert, method) == (SOFT, ENTROPY) else kept
    assert kept is not None
    return kept


def point_of(problem: Problem, expert: Float[np.ndarray, "T S A"], learned: Learned) -> Point:
    """How well a method did, by the exact expectations of its policies and of the expert's."""
    mdp, policies = problem.mdp, learned.policies()
    mu_expert = mdp.feature_expectation(expert)
    mu = learned.shares @ np.array([mdp.feature_expectation(policy) for policy in policies])
    value = learned.shares @ np.array([_value(problem, policy) for policy in policies])
    apart = np.linalg.norm(mu_expert - mdp.feature_expectation(uniform_policy(mdp)))
    return Point(
        weights_evd=problem.loss(_value(problem, mdp.optimal_solution(learned.weights).policy)),
        policy_evd=problem.loss(float(value)),
        gap=float(np.linalg.norm(mu_expert - mu) / apart),
        seconds=learned.seconds,
        converged=learned.converged,
    )


def _value(problem: Problem, policy: Float[np.ndarray, "T S A"]) -> float:
    return float(problem.truth.feature_expectation(policy)[0])


def ambiguity_of(mdp: TabularMDP, weights: Float[np.ndarray, "K"], *, demonstrations: int) -> Ambiguity:
    """What can be told near `weights`: Var(u^T w) >= u^T (n F)^+ u (Cramer and Rao) for n demonstrations."""
    found = identifiable_directions(mdp, weights)
    inside = found.identified @ found.information @ found.identified.T
    told = demonstrations * np.linalg.eigvalsh(inside) > 1.0 / PRIOR**2
    before = mdp.soft_solution(weights).policy
    moved = [mdp.soft_solution(weights + FAR * u).policy for u in found.unidentified]
    return Ambiguity(
        features=len(weights),
        identified=len(found.identified),
        told=int(told.sum()),
        unchanged=max((float(np.abs(after - before).max()) for after in moved), default=0.0),
    )


def _beside(grids: int, size: int, seed: int, bar: Bar) -> tuple[tuple[irl_peer.Beside, ...], str]:
    """The comparison with imitation; or why there is none."""
    if grids == 0:
        return (), "not asked for"
    try:
        python = peer_python(peers_folder(), lambda note: bar.advance(0, note))
    except PeerError as error:  # without a network the rest is still worth measuring
        bar.advance(0, f"without imitation: {error}")
        return (), str(error)
    found = []
    for grid in range(grids):
        rng = np.random.default_rng((seed, len(PROBLEMS), grid))
        found.append(
            irl_peer.beside_imitation(python, size=size, horizon=60, demonstrations=200, held_out=1000, rng=rng)
        )
        bar.advance(note=f"{found[-1].faster:.0f}x as fast as imitation")
    return tuple(found), ""


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and the ends of its 95% interval by Student's t; NaN ends for one value."""
    mean, count = float(np.mean(values)), len(values)
    if count < 2:
        return mean, float("nan"), float("nan")
    half = float(student.ppf(0.975, count - 1) * np.std(values, ddof=1) / np.sqrt(count))
    return mean, mean - half, mean + half


def sections_of(measured: IrlBench) -> dict[str, dict[str, str]]:
    """The sections of a results page."""
    sections = {
        f"Inverse RL: {name}, {measured.size} x {measured.size}": _rows_of_problem(measured, name) for name in PROBLEMS
    }
    beside = irl_peer.rows_of(measured.beside) if measured.beside else {"imitation": f"left out: {measured.missing}"}
    return (
        sections
        | {"Inverse RL: cup scenes, Panda": irl_arm.rows_of(measured.arm)}
        | {"Inverse RL: what is identifiable": _ambiguity_rows(measured)}
        | {"Inverse RL: maximum entropy beside imitation's MCEIRL": beside}
    )


def _rows_of_problem(measured: IrlBench, name: str) -> dict[str, str]:
    rows = {"worlds": f"{len(measured.seeds)}, each with its own demonstrations; means with 95% intervals"}
    for expert, methods in measured.points[name].items():
        rows[f"EVD of the {expert} itself"] = _said(measured.experts[name][expert])
        for what, field in (("EVD of the weights", "weights_evd"), ("feature gap", "gap")):
            for place, count in enumerate(measured.counts):
                said = [f"{m} {_said([getattr(p, field) for p in at[place]])}" for m, at in methods.items()]
                rows[f"{what}, {expert}, {count} demonstrations"] = "; ".join(said)
        mixtures = [[p.policy_evd for p in at] for at in methods[APPRENTICESHIP]]
        said = [f"{_said(at)} from {count}" for at, count in zip(mixtures, measured.counts, strict=True)]
        rows[f"EVD of apprenticeship's mixture, {expert}"] = "; ".join(said)
        times = [f"{m} {np.median([p.seconds for p in at[-1]]):.2g} s" for m, at in methods.items()]
        rows[f"CPU time, {expert}, {measured.counts[-1]} demonstrations, median"] = "; ".join(times)
        stopped = [f"{m} {_share(at)}" for m, at in methods.items()]
        rows[f"reached their tolerance, {expert}"] = "; ".join(stopped)
    return rows


def _said(values: Sequence[float]) -> str:
    mean, low, high = interval(values)
    return f"{mean:.3f}" if np.isnan(low) else f"{mean:.3f} [{low:.3f}, {high:.3f}]"


def _share(at: Sequence[Sequence[Point]]) -> str:
    reached = [point.converged for points in at for point in points]
    return f"{sum(reached)} of {len(reached)}"


def _ambiguity_rows(measured: IrlBench) -> dict[str, str]:
    rows = {}
    for name, worlds in measured.ambiguity.items():
        features, identified, told = (
            _range([getattr(world, field) for world in worlds]) for field in ("features", "identified", "told")
        )
        rows[f"{name}: features"] = features
        rows[f"{name}: directions of w that demonstrations tell at all"] = identified
        rows[
            f"{name}: told to within {PRIOR:g} nat by {measured.counts[-1]} demonstrations of the {ENTROPY} policy"
        ] = told
        change = max(world.unchanged for world in worlds)
        rows[f"{name}: largest change of an action's probability, w moved by {FAR:g} along the others"] = (
            f"{change:.1e}"
        )
    return rows


def _range(values: Sequence[int]) -> str:
    return f"{min(values)}" if min(values) == max(values) else f"{min(values)} to {max(values)}"


def plot(measured: IrlBench, path: Path) -> None:
    """EVD and feature gap against demonstrations, a column for each problem and expert."""
    from matplotlib.figure import Figure

    columns = [(name, expert) for name in measured.points for expert in measured.points[name]]
    figure = Figure(figsize=(3.3 * (len(columns) + len(measured.arm.points)), 6.0), layout="constrained")
    grid = figure.subplots(2, len(columns) + len(measured.arm.points), squeeze=False)
    for axes, (name, expert) in zip(grid.T, columns, strict=False):
        for method, at in measured.points[name][expert].items():
            _curve(axes[0], measured.counts, at, "weights_evd", COLOURS[method], "o-", method)
            _curve(axes[1], measured.counts, at, "gap", COLOURS[method], "o-", method)
        mixture = measured.points[name][expert][APPRENTICESHIP]
        _curve(axes[0], measured.counts, mixture, "policy_evd", COLOURS[APPRENTICESHIP], "o--", "its mixture")
        axes[0].axhline(float(np.mean(measured.experts[name][expert])), color="0.5", linestyle=":", label="the expert")
        axes[0].set(title=f"{name}, {expert}", xscale="log", ylim=(-0.02, 1.02))
        axes[1].set(xlabel="demonstrations", xscale="log")
    highest = max(axes.get_ylim()[1] for axes in grid[1, : len(columns)])
    for axes in grid[1, : len(columns)]:
        axes.set_ylim(0, highest)
    for axes, expert in zip(grid.T[len(columns) :], measured.arm.points, strict=True):
        irl_arm.draw(measured.arm, expert, axes[0], axes[1], list(COLOURS.values()))
    for each in grid.flat:
        each.grid(alpha=0.3)
    grid[0, 0].set(ylabel="EVD (1: random actions)")
    grid[1, 0].set(ylabel="feature gap (1: random actions)")
    grid[0, 0].legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=110)


def _curve(
    axes: Any, counts: Sequence[int], at: Sequence[Sequence[Point]], field: str, colour: str, style: str, label: str
) -> None:
    """Means over seeds with their intervals."""
    means, low, high = np.transpose([interval([getattr(point, field) for point in points]) for points in at])
    axes.plot(counts, means, style, color=colour, label=label, markersize=4)
    axes.fill_between(counts, low, high, color=colour, alpha=0.15, linewidth=0)
