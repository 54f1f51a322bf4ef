"""The eval stage: a policy's success over start states that no demonstration began at."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lfd.core.artifact import new_folder, packed, sha256, unpack, write_json, write_manifest
from lfd.core.protocols import Observer, Observers, Progress, UnitMap, batches, silent, unwatched
from lfd.policies.acting import load_policy
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.run.trial import EvalRecipe, Trial
from lfd.run.wilson import wilson_interval
from lfd.worlds.robosuite_world import EVERY_CORE, RobosuiteWorld, kept_world, make_worlds
from lfd.worlds.robots import RobotConfig, load_robot

STAGE = "eval"
REPORT = "report.json"
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Report:
    """What an evaluation measured; `report.json` holds the same."""

    success_rate: float
    interval: tuple[float, float]
    """95% Wilson interval of the success rate."""
    successes: int
    episodes: int
    mean_steps: float
    """Mean episode length in control steps, failures included."""
    clipped_steps: int
    """Control steps whose action was beyond the controller's limits, and clipped."""
    broken_off: int
    """Episodes that ended because the physics became unstable; their reasons are in `per_episode`."""
    seed: int
    seconds: float
    """Wall time [s], with the time to build the worlds."""
    steps_per_second: float
    """Control steps in a second of wall time, of all worlds together, without the time to build them."""
    per_episode: tuple[dict[str, Any], ...]
    """Index and outcome (`lfd.worlds.rollout.Outcome`) of each episode."""


def evaluate(
    policy: Path,
    recipe: EvalRecipe,
    out: Path,
    *,
    robot: str | None = None,
    forced: bool = False,
    dataset: Path | None = None,
    most_worlds: int = EVERY_CORE,
    cluster: UnitMap | None = None,
    observers: Observers = unwatched,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Report:
    """Run a policy from `recipe.episodes` start states; recordings and the report land in the folder `out`.

    Worlds run in parallel, one a core, `most_worlds` at the most, or on the machines of a `cluster`; the result
    does not depend on where, nor on how many. `robot` is another robot than the policy was trained for, which must be
    `forced`; `dataset` is what a policy that LeRobot trained was trained on, where its folder does not say so.
    `observers` gives what else watches an episode, where it runs in this process.

    Raises `PolicyError` for a policy that cannot be loaded, `OutputError` when `out` exists.
    """
    trial = Trial.of(policy, recipe, robot=robot, forced=forced, dataset=dataset)
    about, used = trial.about, trial.used
    began = time.perf_counter()
    with new_folder(out, overwrite=overwrite) as part:
        (part / "episodes").mkdir()
        if cluster is None:
            most = min(most_worlds, recipe.episodes)
            worlds = make_worlds(about["task"], trial.robot, about["control_hz"], most=most, progress=progress)
            stepping = time.perf_counter()
            ended = _run(worlds, trial, range(recipe.episodes), part / "episodes", observers)
        else:
            load_policy(policy)  # a policy that cannot be loaded shows here and not on a worker
            stepping = time.perf_counter()
            ended = _run_on(cluster, trial, part / "episodes")
        rows = []
        with progress(f"evaluate {about['task']}", recipe.episodes) as bar:
            for row in ended:
                rows.append(row)
                rate = sum(row["steps"] for row in rows) / (time.perf_counter() - stepping)
                bar.advance(note=f"{sum(row['success'] for row in rows)} of {len(rows)} solved, {rate:.0f} steps/s")
        rows.sort(key=lambda row: row["index"])
        now = time.perf_counter()
        report = make_report(rows, recipe, now - began, now - stepping)
        write_json(part / REPORT, asdict(report))
        write_manifest(
            part, kind="evaluation", recipe=used, parents={str(policy): sha256(policy)}, seed=recipe.seed,
            task=about["task"], robot=trial.robot, policy=about["policy"],
        )  # fmt: skip
    return report


def _run(
    worlds: Sequence[RobosuiteWorld],
    trial: Trial,
    indices: Sequence[int],
    episodes: Path,
    observers: Observers = unwatched,
) -> Iterator[Row]:
    """Run the episodes of some numbers and record them into a folder; a row for each, its index and its outcome."""

    def recorders(index: int) -> list[Observer]:
        about, recipe = trial.about, trial.recipe
        origin = Origin(stage=STAGE, policy=about["policy"], seed=recipe.seed, index=index, recipe=trial.used)
        recorder = McapRecorder(episodes / f"episode_{index:06d}{SUFFIX}", origin, keep_failures=True)
        return [recorder, *observers(index)]

    for index, outcome in trial.run(worlds, STAGE, indices, recorders):
        yield {"index": index, **asdict(outcome)}


def _run_on(cluster: UnitMap, trial: Trial, episodes: Path) -> Iterator[Row]:
    """Run all episodes on a cluster; their recordings come back as bytes."""
    shared = packed(trial.policy), trial, load_robot(trial.robot)
    for _, (rows, files) in cluster(_unit, shared, batches(trial.recipe.episodes, cluster.cpus)):
        unpack(files, episodes)
        yield from rows


def _unit(
    shared: tuple[dict[str, bytes], Trial, RobotConfig], indices: Sequence[int]
) -> tuple[list[Row], dict[str, bytes]]:
    """A worker's part of an evaluation: rows, and recordings by name."""
    files, trial, robot = shared
    with TemporaryDirectory() as folder:
        policy, episodes = Path(folder) / "policy", Path(folder) / "episodes"
        unpack(files, policy)
        episodes.mkdir()
        world = kept_world(trial.about["task"], trial.robot, robot, trial.about["control_hz"])
        return list(_run([world], replace(trial, policy=policy), indices, episodes)), packed(episodes)


def make_report(rows: Sequence[Mapping[str, Any]], recipe: EvalRecipe, seconds: float, stepping: float) -> Report:
    """What the rows of all episodes add up to, with the wall time of the evaluation and of its steps [s]."""
    successes = sum(row["success"] for row in rows)
    steps = sum(row["steps"] for row in rows)
    return Report(
        success_rate=successes / len(rows),
        interval=wilson_interval(successes, len(rows)),
        successes=successes,
        episodes=len(rows),
        mean_steps=steps / len(rows),
        clipped_steps=sum(row["clipped"] for row in rows),
        broken_off=sum(bool(row["failure"]) for row in rows),
        seed=recipe.seed,
        seconds=seconds,
        steps_per_second=round(steps / stepping, 1),
        per_episode=tuple(dict(row) for row in rows),
    )
