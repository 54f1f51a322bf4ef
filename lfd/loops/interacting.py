"""Robots among people: episodes of a scene, recorded, and what they add up to."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from lfd.core.artifact import new_folder, write_json, write_manifest
from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Observation, Observer, Progress, Transition, World, silent
from lfd.interaction.interactive_robot import RobotOptions
from lfd.interaction.scenes import InteractionScene, scene_of
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.run.wilson import wilson_interval
from lfd.worlds.rollout import episode_rng, rollout

STAGE = "eval"
CERTAIN = 0.9
"""Probability of the person's true type that counts as certainty."""
REPORT, PICTURE = "report.json", "entropy.png"
FARTHEST_M = 30.0
"""Along the way, beyond which the picture shows nothing [m]."""


@dataclass(frozen=True, kw_only=True)
class InteractRecipe:
    """Which scene, people and robots."""

    scene: str
    """One of `lfd.interaction.scenes`."""
    robots: tuple[RobotOptions, ...]
    person: str
    """Who is met: one of the scene's people, such as random."""
    episodes: int
    """Episodes of each robot; number i begins alike for all of them."""
    seed: int
    control_hz: int = 5
    """Control steps a second [Hz]."""
    max_seconds: float = 20.0
    """Simulated time after which an episode ends [s]."""
    hold_seconds: float = 1.0
    """Simulated time for which the robot must stay where it should be [s]."""
    rationality: float = 0.3
    """Of the people; inf for what is best."""

    def check(self) -> None:
        """Raise `InputError` for numbers out of range, or a robot that is given twice."""
        scene = scene_of(self.scene)
        if self.person not in scene.people:
            raise UnknownName("person", self.person, scene.people)
        for name in ("episodes", "control_hz", "max_seconds", "hold_seconds"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name} = {getattr(self, name)}: must be greater than 0")
        if self.seed < 0:
            raise InputError(f"seed = {self.seed}: must not be negative")
        names = [label(robot) for robot in self.robots]
        if not names or len(set(names)) < len(names):
            raise InputError(f"robots are {', '.join(names) or 'none'}: give at least one, each of them once")
        for robot in self.robots:
            robot.check()


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One episode."""

    index: int
    person: str
    """The type that the person was nearest to."""
    success: bool
    seconds: float
    """Time until the robot was where it should be [s]; the longest where it never was."""
    collided: bool
    least_distance: float
    """Smallest distance between the surfaces [m]."""
    certain_s: float | None
    """When the belief was first certain of the person's type [s]; the longest where it never was."""
    entropy: tuple[float, ...]
    """Of the belief at each step [nat]; empty for robots without one."""
    offsets: tuple[tuple[float, float], ...]
    """Where the robot was at each step, from the person: ahead and to the left, in the world's axes [m]."""
    plan_ms: float
    """Median processor time of a plan [ms]."""
    solves: float
    """Best responses of a plan, in the mean."""
    per_gradient: float
    """And of one gradient."""


class _Watch:
    """Collects what a trial is made of."""

    def __init__(self, scene: InteractionScene) -> None:
        self._scene = scene
        self.distances: list[float] = []
        self.offsets: list[tuple[float, float]] = []
        self.beliefs: list[Mapping[str, float]] = []
        self.entropy: list[float] = []
        self.failure = ""

    def begin(self, world: World, observation: Observation) -> None:
        self.person = self._scene.type_of(world.get_state().memory["theta"])
        self._see(observation)

    def step(self, world: World, transition: Transition) -> None:
        signals = transition.decision.signals
        if "belief" in signals:
            self.beliefs.append(signals["belief"])
            self.entropy.append(signals["belief_entropy"]["entropy"])
        self.failure = transition.result.failure
        self._see(transition.result.observation)

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""

    def _see(self, observation: Observation) -> None:
        self.offsets.append(self._scene.offset(observation))
        self.distances.append(self._scene.distance(observation))


def label(robot: RobotOptions) -> str:
    """What a robot is called in reports: its kind, and whom it takes people for."""
    return f"known-{robot.assumed}" if robot.kind == "known" else robot.kind


def run_trial(recipe: InteractRecipe, robot: RobotOptions, index: int, observers: Sequence[Observer] = ()) -> Trial:
    """Episode `index` of a robot."""
    scene = scene_of(recipe.scene)
    world = scene.world(recipe.person, recipe.control_hz, recipe.rationality)
    policy, watch = scene.robot(recipe.control_hz, robot), _Watch(scene)
    hold = max(1, round(recipe.hold_seconds * recipe.control_hz))
    outcome = rollout(
        world,
        policy,
        [watch, *observers],
        episode_rng(STAGE, recipe.seed, index),
        horizon=round(recipe.max_seconds * recipe.control_hz),
        hold_steps=hold,
    )
    certain = [t for t, belief in enumerate(watch.beliefs) if belief[watch.person] >= CERTAIN]
    return Trial(
        index=index,
        person=watch.person,
        success=outcome.success,
        seconds=(outcome.steps - hold + 1) / recipe.control_hz if outcome.success else recipe.max_seconds,
        collided=bool(watch.failure),
        least_distance=min(watch.distances),
        certain_s=(certain[0] / recipe.control_hz if certain else recipe.max_seconds) if watch.beliefs else None,
        entropy=tuple(watch.entropy),
        offsets=tuple(watch.offsets),
        plan_ms=1e3 * float(np.median(policy.planner.seconds)),
        solves=float(np.mean(policy.planner.solves)),
        per_gradient=float(np.mean(policy.planner.per_gradient)),
    )


def interact(
    recipe: InteractRecipe,
    out: Path,
    *,
    parents: Mapping[str, str] | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Run all robots; recordings land in a folder for each, beside the report and a picture. Returns the report.

    `parents` are what the robots' rewards were read from, with their hashes. Raises what `InteractRecipe.check` raises,
    `OutputError` when `out` exists.
    """
    recipe.check()
    tables = {"interact": json.loads(json.dumps(asdict(recipe)))}
    trials: dict[str, list[Trial]] = {}
    with new_folder(out, overwrite=overwrite) as part:
        with progress(f"interact {recipe.scene}", recipe.episodes * len(recipe.robots)) as bar:
            for robot in recipe.robots:
                name = label(robot)
                (part / name).mkdir()
                trials[name] = []
                for index in range(recipe.episodes):
                    origin = Origin(stage=STAGE, policy=name, seed=recipe.seed, index=index, recipe=tables)
                    path = part / name / f"episode_{index:06d}{SUFFIX}"
                    recorder = McapRecorder(path, origin, keep_failures=True)
                    trials[name].append(run_trial(recipe, robot, index, [recorder]))
                    bar.advance(note=f"{name}: {sum(t.success for t in trials[name])} of {index + 1} there")
        report = {name: summary(rows) for name, rows in trials.items()}
        rows = {name: [asdict(trial) for trial in of] for name, of in trials.items()}
        write_json(part / REPORT, {"robots": report, "trials": rows})
        (part / PICTURE).write_bytes(picture(trials, recipe.control_hz))
        write_manifest(part, kind="interaction", recipe=tables, parents=parents or {}, seed=recipe.seed)
    return report


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """Means of trials with 95% intervals, by Student's t; of shares, by Wilson."""
    done, collided = (sum(getattr(trial, name) for trial in trials) for name in ("success", "collided"))
    found: dict[str, Any] = {
        "episodes": len(trials),
        "done": [done, *wilson_interval(done, len(trials))],
        "collisions": [collided, *wilson_interval(collided, len(trials))],
        "seconds": interval([trial.seconds for trial in trials]),
        "least_distance_m": interval([trial.least_distance for trial in trials]),
        "smallest_distance_m": min(trial.least_distance for trial in trials),
        "plan_ms": float(np.median([trial.plan_ms for trial in trials])),
        "human_solves": float(np.mean([trial.solves for trial in trials])),
    }
    certain = [trial.certain_s for trial in trials if trial.certain_s is not None]
    if certain:
        found["certain_s"] = interval(certain)
        found["final_entropy_nat"] = interval([trial.entropy[-1] for trial in trials])
    return found


def interval(values: Sequence[float]) -> list[float]:
    """Mean and the ends of its 95% interval; the mean three times for one value, of which nothing is known."""
    mean, count = float(np.mean(values)), len(values)
    half = float(student.ppf(0.975, count - 1) * np.std(values, ddof=1) / np.sqrt(count)) if count > 1 else 0.0
    return [mean, mean - half, mean + half]


def told(of: dict[str, Any]) -> str:
    """A robot's row of the table."""
    parts = [
        f"{of['done'][0]} of {of['episodes']} there in {said(of['seconds'])} s",
        f"least distance {said(of['least_distance_m'])} m, at worst {of['smallest_distance_m']:.2f} m",
        f"{of['collisions'][0]} collisions",
        f"{of['plan_ms']:.0f} ms of the processor for a plan",
    ]
    if "certain_s" in of:
        parts.append(f"certain after {said(of['certain_s'])} s, entropy {said(of['final_entropy_nat'])} nat in the end")
    return "; ".join(parts)


def said(of: list[float]) -> str:
    """A mean with its interval."""
    mean, low, high = of
    return f"{mean:.2f} [{low:.2f}, {high:.2f}]"


def picture(trials: Mapping[str, Sequence[Trial]], control_hz: int) -> bytes:
    """The belief's mean entropy against time, and where each robot was from the person in its first episode: PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, (name, of) in enumerate(trials.items()):
        colour = f"C{number}"
        right.plot(*np.array(of[0].offsets).T, ".-", color=colour, label=name, markersize=3, linewidth=1)
        right.plot(*of[0].offsets[0], "o", color="0.3", markersize=5)
        if not of[0].entropy:
            continue
        longest = max(len(trial.entropy) for trial in of)
        rows = np.array([np.pad(trial.entropy, (0, longest - len(trial.entropy)), mode="edge") for trial in of])
        times, mean = np.arange(longest) / control_hz, rows.mean(axis=0)
        error = 1.96 * rows.std(axis=0) / np.sqrt(len(rows))
        left.plot(times, mean, color=colour, label=name)
        left.fill_between(times, mean - error, mean + error, color=colour, alpha=0.15, linewidth=0)
    unknown = max((trial.entropy[0] for of in trials.values() for trial in of if trial.entropy), default=np.log(2.0))
    left.axhline(unknown, color="0.6", linestyle=":", label="nothing known")
    left.set(xlabel="time [s]", ylabel="entropy of the belief [nat]", ylim=(-0.02, 1.08 * unknown))
    right.plot(0.0, 0.0, "ks", markersize=7)
    far = min(FARTHEST_M, 1.1 * max(abs(x) for of in trials.values() for x, _ in of[0].offsets))
    right.set(xlabel="x from the person [m]", ylabel="y from the person [m]", title="first episode", xlim=(-far, far))
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize="small")
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    return drawn.getvalue()
