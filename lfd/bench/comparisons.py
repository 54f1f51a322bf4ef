"""`lfd bench comparisons`: how soon the weights are known, by which question is asked.
 Simulated people have weights w* on the unit sphere, and answer by Bradley and Terry's model or without a mistake. Each
of them is asked by each strategy about pairs of a pool of trajectories, whose features are standard normal; the learner
knows the person's rationality. After each answer the alignment is the cosine of w* and the posterior's mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.processes import ProcessMap, cores, in_order
from lfd.core.protocols import Progress, silent
from lfd.reward_learning.preference_posterior import PreferencePosterior
from lfd.reward_learning.queries import best_query

RANDOM, VOLUME, INFORMATION = "random", "volume removal", "information gain"
STRATEGIES = (RANDOM, VOLUME, INFORMATION)
CRITERIA: dict[str, Any] = {VOLUME: "volume_removal", INFORMATION: "information_gain"}
COLOURS = {RANDOM: "C7", VOLUME: "C1", INFORMATION: "C0"}
RATIONALITY = 5.0
"""Of noisy people: a difference of 1 in reward is told right with probability 0.993, one of 0.2 with 0.73."""
SURE = 20.0
"""Rationality that the learner takes people without mistakes to have."""
SAMPLES, JUDGED_BY, POOL = 100, 1000, 100
"""Samples that choose a question, samples whose mean is judged, trajectories to ask about."""
GOAL = 0.95


@dataclass(frozen=True)
class Case:
    """Who is asked about what."""

    features: int
    is_noisy: bool


@dataclass(frozen=True, kw_only=True)
class ComparisonsBench:
    """What one run measured."""

    people: int
    questions: int
    alignment: dict[str, dict[str, Float[np.ndarray, "P Q"]]]
    """Case and strategy to the alignment of each person after each answer."""


def bench_comparisons(
    *, features: Sequence[int], people: int, questions: int, seed: int, progress: Progress = silent
) -> ComparisonsBench:
    """Ask some people with each strategy, at each number of features, with and without noise."""
    cases = [Case(count, noisy) for count in features for noisy in (True, False)]
    units = [(case, strategy, seed, person) for case in cases for strategy in STRATEGIES for person in range(people)]
    found: dict[str, dict[str, list[np.ndarray]]] = {}
    with progress("bench comparisons", len(units)) as bar:
        curves = in_order(ProcessMap(cores())(_asked, questions, units))
        for (case, strategy, _, _), curve in zip(units, curves, strict=True):
            found.setdefault(_name(case), {}).setdefault(strategy, []).append(curve)
            bar.advance(note=f"{_name(case)}, {strategy}: {curve[-1]:.2f}")
    alignment = {name: {s: np.array(rows) for s, rows in each.items()} for name, each in found.items()}
    return ComparisonsBench(people=people, questions=questions, alignment=alignment)


def _asked(questions: int, unit: tuple[Case, str, int, int]) -> Float[np.ndarray, "Q"]:
    """A worker's part: one person, asked by one strategy. The person and the pool are the same for all strategies."""
    case, strategy, seed, person = unit
    drawn = np.random.default_rng([seed, person, case.features])
    truth, pool = drawn.normal(size=case.features), drawn.normal(size=(POOL, case.features))
    truth /= np.linalg.norm(truth)
    rng = np.random.default_rng([seed, person, case.features, STRATEGIES.index(strategy)])
    rationality = RATIONALITY if case.is_noisy else SURE
    posterior = PreferencePosterior(case.features, rationality=rationality, prior="sphere", rng=rng)
    curve = np.empty(questions)
    for number in range(questions):
        i, j = _question(strategy, pool, posterior, rationality, rng)
        better = truth @ (pool[i] - pool[j])
        says_a = rng.random() < 1.0 / (1.0 + np.exp(-RATIONALITY * better)) if case.is_noisy else better > 0.0
        posterior.update(pool[i], pool[j], "a" if says_a else "b")
        mean = posterior.sample(JUDGED_BY).mean(axis=0)
        curve[number] = truth @ mean / np.linalg.norm(mean)
    return curve


def _question(
    strategy: str,
    pool: Float[np.ndarray, "N K"],
    posterior: PreferencePosterior,
    rationality: float,
    rng: np.random.Generator,
) -> tuple[int, int]:
    if strategy == RANDOM:
        first, second = rng.choice(len(pool), 2, replace=False)
        return int(first), int(second)
    query = best_query(pool, posterior.sample(SAMPLES), criterion=CRITERIA[strategy], rationality=rationality)
    return query.i, query.j


def questions_to(curves: Float[np.ndarray, "P Q"], goal: float) -> Float[np.ndarray, "P"]:
    """For each person the first answer from which on the alignment stays at `goal` or above; inf for never."""
    below = curves < goal
    last = np.where(below.any(axis=1), curves.shape[1] - np.argmax(below[:, ::-1], axis=1), 0)
    return np.where(last == curves.shape[1], np.inf, last + 1.0)


def rows_of(measured: ComparisonsBench) -> dict[str, str]:
    """The lines of a results page."""
    rows = {"people": f"{measured.people} a case, {measured.questions} questions each, a pool of {POOL} trajectories"}
    for case, each in measured.alignment.items():
        needed = {strategy: questions_to(curves, GOAL) for strategy, curves in each.items()}
        said = [f"{strategy} {_median(values)}" for strategy, values in needed.items()]
        rows[f"{case}: questions to alignment {GOAL:g}, median [quartiles]"] = ", ".join(said)
        ends = [f"{strategy} {_mean(curves[:, -1])}" for strategy, curves in each.items()]
        rows[f"{case}: alignment after {measured.questions}, mean +- 95%"] = ", ".join(ends)
    return rows


def _median(values: Float[np.ndarray, "P"]) -> str:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75], method="inverted_cdf")
    return f"{_count(middle)} [{_count(low)}, {_count(high)}]"


def _count(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "never"


def _mean(values: Float[np.ndarray, "P"]) -> str:
    return f"{values.mean():.3f} +- {1.96 * values.std(ddof=1) / np.sqrt(len(values)):.3f}"


def _name(case: Case) -> str:
    return f"{case.features} features, {'noisy' if case.is_noisy else 'no mistakes'}"


def plot(measured: ComparisonsBench, path: Path) -> None:
    """Mean alignment against the number of answers, with 95% intervals of the mean."""
    from matplotlib.figure import Figure

    cases = list(measured.alignment)
    figure = Figure(figsize=(3.2 * ((len(cases) + 1) // 2), 5.0), layout="constrained")
    grid = figure.subplots(2, (len(cases) + 1) // 2, sharex=True, sharey=True, squeeze=False)
    for axes, case in zip(grid.T.ravel(), cases, strict=False):
        for strategy, curves in measured.alignment[case].items():
            asked, mean = np.arange(1, curves.shape[1] + 1), curves.mean(axis=0)
            half = 1.96 * curves.std(axis=0, ddof=1) / np.sqrt(len(curves))
            axes.plot(asked, mean, color=COLOURS[strategy], label=strategy)
            axes.fill_between(asked, mean - half, mean + half, color=COLOURS[strategy], alpha=0.2, linewidth=0)
        axes.axhline(GOAL, color="0.5", linewidth=0.8, linestyle=":")
        axes.set(title=case, ylim=(0.0, 1.02))
        axes.grid(alpha=0.3)
    for axes in grid[-1]:
        axes.set_xlabel("answers")
    grid[0, 0].set_ylabel("alignment")
    grid[0, -1].legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=150)
