"""`lfd bench interaction`: four robots among random people, and what planning with the implicit gradient spares.

Episode i begins alike for every robot. Ratios of times are of means, with the interval of their paired differences
beside them. Planning is compared in the situations of one episode: the same planner with central differences, which
needs 2 n best responses more for a gradient of n controls.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfd.core.protocols import Progress, silent
from lfd.interaction.driving_robots import DriverOptions
from lfd.loops.interacting import InteractRecipe, Trial, interval, label, picture, run_trial, said, summary, told

ROBOTS = (
    DriverOptions(kind="obstacle"),
    DriverOptions(kind="known", assumed="aggressive"),
    DriverOptions(kind="passive"),
    DriverOptions(kind="active"),
)
DIFFERENCE = 1e-5
"""Step of the central differences [m/s^2, rad]."""
CONTROL_HZ = 5


@dataclass(frozen=True, kw_only=True)
class InteractionBench:
    """What one run measured."""

    scenes: dict[str, dict[str, list[Trial]]]
    """Scene to robot to its trials."""
    planning: dict[str, dict[str, float]]
    """implicit and differences to processor time of a plan [ms] and best responses of a plan."""


def bench_interaction(
    *, scenes: Sequence[str], episodes: int, seed: int, compared_steps: int, progress: Progress = silent
) -> InteractionBench:
    """Run `episodes` of each scene with each robot, and compare planners over `compared_steps` steps."""
    found: dict[str, dict[str, list[Trial]]] = {}
    with progress("bench interaction", len(scenes) * len(ROBOTS) * episodes + 2) as bar:
        for scene in scenes:
            recipe = recipe_of(scene, episodes, seed)
            found[scene] = {}
            for robot in ROBOTS:
                trials = found[scene][label(robot)] = []
                for index in range(episodes):
                    trials.append(run_trial(recipe, robot, index))
                    bar.advance(note=f"{scene}, {label(robot)}")
        planning = {}
        for name, difference in (("implicit", 0.0), ("differences", DIFFERENCE)):
            planning[name] = planning_cost(recipe_of(scenes[0], 1, seed), difference, compared_steps)
            bar.advance(note=f"planning, {name}")
    return InteractionBench(scenes=found, planning=planning)


def recipe_of(scene: str, episodes: int, seed: int) -> InteractRecipe:
    """The people of the benchmark: either type, with the same probability."""
    return InteractRecipe(
        scene=scene, robots=ROBOTS, person="random", episodes=episodes, seed=seed, control_hz=CONTROL_HZ
    )


def planning_cost(recipe: InteractRecipe, difference: float, steps: int) -> dict[str, float]:
    """Medians over the first steps of an episode of the robot that infers."""
    robot = DriverOptions(kind="passive", difference=difference)
    short = replace(recipe, max_seconds=steps / recipe.control_hz)
    trial = run_trial(short, robot, 0)
    return {"ms": trial.plan_ms, "solves": trial.solves}


def sections_of(measured: InteractionBench) -> dict[str, dict[str, str]]:
    """The sections of a results page."""
    sections = {}
    for scene, trials in measured.scenes.items():
        count = len(next(iter(trials.values())))
        rows = {"people": f"{count} for each robot, aggressive or passive; means with 95% intervals"}
        rows |= {name: told(summary(of)) for name, of in trials.items()}
        rows |= comparisons(trials)
        sections[f"Interaction: {scene}"] = rows
    implicit, differences = measured.planning["implicit"], measured.planning["differences"]
    sections["Interaction: a plan with implicit and with finite differences"] = {
        "best responses of a plan, horizon 5": f"{implicit['solves']:.1f} and {differences['solves']:.1f}: "
        f"{differences['solves'] / implicit['solves']:.1f}x as many",
        "processor time of a plan": f"{implicit['ms']:.0f} ms and {differences['ms']:.0f} ms: "
        f"{differences['ms'] / implicit['ms']:.1f}x",
        "best responses of one gradient of 10 controls": "1 and 21",
    }
    return sections


def comparisons(trials: Mapping[str, Sequence[Trial]]) -> dict[str, str]:
    """The issue's questions: certainty of who asks against who watches, time against the robot that sees obstacles."""
    asks, watches = ([trial.certain_s or 0.0 for trial in trials[name]] for name in ("active", "passive"))
    rows = {
        "certain: active / passive": f"{np.mean(asks) / np.mean(watches):.2f} (target 0.5), difference "
        f"{said(interval(np.subtract(asks, watches).tolist()))} s"
    }
    base = trials["obstacle"]
    for name, of in trials.items():
        if name == "obstacle":
            continue
        seconds, others = ([trial.seconds for trial in each] for each in (of, base))
        closer = [trial.least_distance - other.least_distance for trial, other in zip(of, base, strict=True)]
        rows[f"time: {name} / obstacle"] = (
            f"{np.mean(seconds) / np.mean(others):.2f} (target 0.7), difference "
            f"{said(interval(np.subtract(seconds, others).tolist()))} s; least distance {said(interval(closer))} m more"
        )
        for person in sorted({trial.person for trial in base}):
            pairs = [(t.seconds, o.seconds) for t, o in zip(of, base, strict=True) if o.person == person]
            means = np.mean(pairs, axis=0)
            rows[f"time: {name} / obstacle, {person} people"] = f"{means[0] / means[1]:.2f}, {len(pairs)} episodes"
    return rows


def plot(measured: InteractionBench, folder: Path) -> None:
    """A picture for each scene: entropy against time, and the first episode."""
    for scene, trials in measured.scenes.items():
        (folder / f"interaction_{scene}.png").write_bytes(picture(trials, CONTROL_HZ))


def as_dict(measured: InteractionBench) -> dict[str, Any]:
    """All that was measured, summed up."""
    scenes = {name: {robot: summary(of) for robot, of in trials.items()} for name, trials in measured.scenes.items()}
    return {"scenes": scenes, "planning": measured.planning}
