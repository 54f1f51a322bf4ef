"""What `lfd bench interaction` says: tables and a picture of its trials.

Means of times and distances have Student's interval. A few episodes in which nothing was ever certain decide a mean, so
that certainty is told by medians, with percentile intervals of a bootstrap over episodes (Efron 1979); robots met the
same people, so that ratios are resampled in pairs.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.bench.bootstrap import median_interval, ratio_interval
from lfd.bench.interaction import CONTROL_HZ, InteractionBench
from lfd.loops.interacting import Trial, interval, said, summary, told

MOMENTS_S = (0.4, 1.0, 2.0, 4.0)
"""When the table tells the entropy [s]."""
SOONER, CERTAIN_IN = 0.7, 0.5
"""Targets: time against the robot that sees obstacles, certainty of who asks against who watches."""


def sections_of(measured: InteractionBench) -> dict[str, dict[str, str]]:
    """The sections of a results page."""
    sections = {}
    for scene, trials in measured.scenes.items():
        count = len(next(iter(trials.values())))
        rows = {"people": f"{count} for each robot, the same ones, of types drawn at random; means with 95% intervals"}
        rows |= {name: told(summary(of)) for name, of in trials.items()}
        rows |= beliefs(trials) | comparisons(trials)
        sections[f"Interaction: {scene}"] = rows
    rows = {}
    for scene, of in measured.planning.items():
        implicit, differences = of["implicit"], of["differences"]
        for key, what in (("per_gradient", "a gradient"), ("solves", "a plan, all starts included")):
            rows[f"{scene}: best responses of {what}"] = (
                f"{implicit[key]:.1f} and {differences[key]:.1f}: {differences[key] / implicit[key]:.1f}x as many"
            )
        rows[f"{scene}: processor time of a plan"] = (
            f"{implicit['ms']:.0f} ms and {differences['ms']:.0f} ms: {differences['ms'] / implicit['ms']:.1f}x"
        )
    sections["Interaction: a plan with implicit and with finite differences"] = rows
    return sections


def beliefs(trials: Mapping[str, Sequence[Trial]]) -> dict[str, str]:
    """How soon robots that have a belief know, and its entropy against time."""
    rows = {}
    for name, of in trials.items():
        if of[0].certain_s is None:
            continue
        certain = np.array([trial.certain_s for trial in of])
        rows[f"{name}: certain after, median"] = f"{said(median_interval(certain))} s"
        entropies = entropy_rows(of)
        at = [min(round(moment * CONTROL_HZ), entropies.shape[1] - 1) for moment in MOMENTS_S]
        rows[f"{name}: entropy after {', '.join(f'{moment:g}' for moment in MOMENTS_S)} s"] = (
            ", ".join(said(interval(entropies[:, k].tolist())) for k in at) + " nat"
        )
    return rows


def comparisons(trials: Mapping[str, Sequence[Trial]]) -> dict[str, str]:
    """The issue's questions: certainty of who asks against who watches, time against the robot that sees obstacles."""
    asks, watches = (np.array([trial.certain_s for trial in trials[name]]) for name in ("active", "passive"))
    rows = {
        "certain: active / passive": f"medians {said(ratio_interval(asks, watches, np.median))} (target "
        f"{CERTAIN_IN:g}), means {said(ratio_interval(asks, watches, np.mean))}"
    }
    base = trials["obstacle"]
    for name, of in trials.items():
        if name == "obstacle":
            continue
        seconds, others = (np.array([trial.seconds for trial in each]) for each in (of, base))
        closer = [trial.least_distance - other.least_distance for trial, other in zip(of, base, strict=True)]
        rows[f"time: {name} / obstacle"] = (
            f"means {said(ratio_interval(seconds, others, np.mean))} (target {SOONER:g}), medians "
            f"{said(ratio_interval(seconds, others, np.median))}; least distance {said(interval(closer))} m more"
        )
        for person in sorted({trial.person for trial in base}):
            is_of = np.array([trial.person == person for trial in base])
            rows[f"time: {name} / obstacle, {person} people"] = (
                f"means {said(ratio_interval(seconds[is_of], others[is_of], np.mean))}, {is_of.sum()} episodes"
            )
    return rows


def entropy_rows(of: Sequence[Trial]) -> Float[np.ndarray, "N T"]:
    """The belief's entropy of each trial; where one has ended it stays as it was."""
    longest = max(len(trial.entropy) for trial in of)
    return np.array([np.pad(trial.entropy, (0, longest - len(trial.entropy)), mode="edge") for trial in of])


def plot(measured: InteractionBench, path: Path) -> None:
    """A row for each scene: entropy of the beliefs, and how many episodes were there, against time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.1 * len(measured.scenes)), layout="constrained")
    axes = figure.subplots(len(measured.scenes), 2, squeeze=False)
    for (left, right), (scene, trials) in zip(axes, measured.scenes.items(), strict=True):
        for number, (name, of) in enumerate(trials.items()):
            colour, latest = f"C{number}", max(trial.seconds for trial in of)
            there = np.sort([trial.seconds for trial in of if trial.success])
            steps = np.append(np.arange(len(there) + 1), len(there)) / len(of)
            right.step(np.concatenate([[0.0], there, [latest]]), steps, where="post", color=colour, label=name)
            if not of[0].entropy:
                continue
            rows = entropy_rows(of)
            times, mean = np.arange(rows.shape[1]) / CONTROL_HZ, rows.mean(axis=0)
            error = 1.96 * rows.std(axis=0) / np.sqrt(len(rows))
            left.plot(times, mean, color=colour, label=name)
            left.fill_between(times, mean - error, mean + error, color=colour, alpha=0.15, linewidth=0)
        left.set(xlabel="time [s]", ylabel="entropy of the belief [nat]", xlim=(0.0, 10.0), ylim=(0.0, None))
        right.set(xlabel="time [s]", ylabel="share of episodes that are there", ylim=(0.0, 1.02))
        for drawn in (left, right):
            drawn.set_title(scene)
            drawn.grid(alpha=0.3)
            drawn.legend(frameon=False, fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def as_dict(measured: InteractionBench) -> dict[str, Any]:
    """All that was measured, summed up."""
    scenes = {name: {robot: summary(of) for robot, of in trials.items()} for name, trials in measured.scenes.items()}
    return {"scenes": scenes, "planning": measured.planning}
