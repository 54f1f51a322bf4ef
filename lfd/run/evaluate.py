"""The eval stage: a policy's success over start states that no demonstration began at."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lfd.core.artifact import new_folder, packed, sha256, unpack, write_json, write_manifest
from lfd.core.errors import RecipeError
from lfd.core.protocols import Progress, UnitMap, World, batches, silent
from lfd.core.recipe import as_table
from lfd.policies.acting import AskedOnce, LearnedPolicy, about_policy, load_policy
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.run.wilson import wilson_interval
from lfd.worlds.robosuite_world import EVERY_CORE, kept_world, make_worlds
from lfd.worlds.robots import RobotConfig, load_robot
from lfd.worlds.rollout import Start, episode_rng, rollouts

STAGE = "eval"
REPORT = "report.json"


@dataclass(frozen=True, kw_only=True)
class EvalRecipe:
    """The `[eval]` table of a file in `policies/`."""

    episodes: int
    """Start states to try."""
    seed: int
    """Seed of the start states; they differ from those of recordings of the same seed."""
    max_seconds: float
    """Simulated time after which an episode has failed [s]."""
    hold_seconds: float
    """Simulated time for which the task must stay solved [s]."""

    def check(self, where: str) -> None:
        for key in ("episodes", "max_seconds", "hold_seconds"):
            if getattr(self, key) <= 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0")
        if self.seed < 0:
            raise RecipeError(f"{where} seed = {self.seed}: must not be negative")


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
    most_worlds: int = EVERY_CORE,
    cluster: UnitMap | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Report:
    """Run a policy from `recipe.episodes` start states; recordings and the report land in the folder `out`.

    Worlds run in parallel, one a core, `most_worlds` at the most, or on the machines of a `cluster`; the result
    does not depend on where, nor on how many. Raises `PolicyError` for a policy that cannot be loaded,
    `OutputError` when `out` exists.
    """
    about = about_policy(policy)
    used = {**about["recipe"], "eval": as_table(recipe)}
    began = time.perf_counter()
    with new_folder(out, overwrite=overwrite) as part:
        (part / "episodes").mkdir()
        if cluster is None:
            most = min(most_worlds, recipe.episodes)
            worlds = make_worlds(about["task"], about["robot"], about["control_hz"], most=most, progress=progress)
            stepping = time.perf_counter()
            ended = _run(worlds, policy, recipe, range(recipe.episodes), part / "episodes")
        else:
            load_policy(policy)  # a policy that cannot be loaded shows here and not on a worker
            stepping = time.perf_counter()
            ended = _run_on(cluster, policy, recipe, part / "episodes")
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
            task=about["task"], robot=about["robot"], policy=about["policy"],
        )  # fmt: skip
    return report


def _run(
    worlds: Sequence[World], policy: Path, recipe: EvalRecipe, indices: Sequence[int], episodes: Path
) -> Iterator[dict[str, Any]]:
    """Run the episodes of some numbers and record them into a folder; a row for each, its index and its outcome."""
    learned, hz = LearnedPolicy(policy, worlds[0].spec), worlds[0].spec.control_hz
    used = {**about_policy(policy)["recipe"], "eval": as_table(recipe)}

    def start(index: int) -> Start:
        origin = Origin(stage=STAGE, policy=learned.name, seed=recipe.seed, index=index, recipe=used)
        recorder = McapRecorder(episodes / f"episode_{index:06d}{SUFFIX}", origin, keep_failures=True)
        return Start(index=index, rng=episode_rng(STAGE, recipe.seed, index), observers=[recorder])

    waiting = iter(indices)
    ended = rollouts(
        worlds,
        AskedOnce(learned),
        lambda: next((start(index) for index in waiting), None),
        horizon=round(recipe.max_seconds * hz),
        hold_steps=max(1, round(recipe.hold_seconds * hz)),
    )
    for begun, outcome in ended:
        yield {"index": begun.index, **asdict(outcome)}


def _run_on(cluster: UnitMap, policy: Path, recipe: EvalRecipe, episodes: Path) -> Iterator[dict[str, Any]]:
    """Run all episodes on a cluster; their recordings come back as bytes."""
    robot = load_robot(about_policy(policy)["robot"])
    shared = packed(policy), recipe, robot
    for _, (rows, files) in cluster(_unit, shared, batches(recipe.episodes, cluster.cpus)):
        unpack(files, episodes)
        yield from rows


def _unit(
    shared: tuple[dict[str, bytes], EvalRecipe, RobotConfig], indices: Sequence[int]
) -> tuple[list[dict[str, Any]], dict[str, bytes]]:
    """A worker's part of an evaluation: rows, and recordings by name."""
    files, recipe, robot = shared
    with TemporaryDirectory() as folder:
        policy, episodes = Path(folder) / "policy", Path(folder) / "episodes"
        unpack(files, policy)
        episodes.mkdir()
        about = about_policy(policy)
        world = kept_world(about["task"], about["robot"], robot, about["control_hz"])
        return list(_run([world], policy, recipe, indices, episodes)), packed(episodes)


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
