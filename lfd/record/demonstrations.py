"""The record stage: demonstrations of a task, as many as the recipe asks for, one file each."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lfd.core.artifact import check_output, packed, unpack, write_manifest
from lfd.core.errors import LfdError, RecipeError
from lfd.core.protocols import Policy, Progress, UnitMap, World, batches, silent
from lfd.core.recipe import as_table
from lfd.experts.noise import NoisyPolicy
from lfd.experts.registry import check_expert, make_expert
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.worlds.robosuite_world import EVERY_CORE, RobosuiteWorld, kept_world, make_worlds
from lfd.worlds.robots import RobotConfig, load_robot
from lfd.worlds.rollout import OneEach, Outcome, Start, episode_rng, rollouts
from lfd.worlds.tasks import load_task

STAGE = "record"


@dataclass(frozen=True, kw_only=True)
class RecordRecipe:
    """The `[record]` table of a file in `datasets/`."""

    task: str
    """Task to demonstrate, for example Lift."""
    robot: str
    """Robot config, the name of a file in robot_configs/."""
    control_hz: int
    """Control steps a second [Hz]."""
    episodes: int
    """Successful demonstrations to record."""
    seed: int
    """Seed of the start states and of the noise."""
    max_seconds: float
    """Simulated time after which a demonstration has failed [s]."""
    hold_seconds: float
    """Simulated time for which the task must stay solved [s]."""
    action_noise: float
    """Standard deviation of the noise on the expert's actions, in units of the action."""
    cameras: tuple[str, ...] = ()
    """Cameras of the model whose pictures are recorded, for example agentview and robot0_eye_in_hand."""
    camera_height: int = 128
    """Height of the pictures [pixels]."""
    camera_width: int = 128
    """Width of the pictures [pixels]."""
    attempts_per_episode: int = 3
    """Recording gives up after this many attempts for each demonstration asked for."""

    def check(self, where: str) -> None:
        positive = ("control_hz", "episodes", "max_seconds", "hold_seconds", "attempts_per_episode")
        positive += ("camera_height", "camera_width")
        for key in positive:
            if getattr(self, key) <= 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0")
        for key in ("seed", "action_noise"):
            if getattr(self, key) < 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must not be negative")


@dataclass(frozen=True)
class Recorded:
    """What a run of the record stage did."""

    episodes: int
    failures: int
    steps: int
    """Control steps of all attempts."""
    clipped_steps: int
    """Control steps whose action was beyond the controller's limits, and clipped."""
    steps_per_second: float
    """Control steps in a second of wall time, of all worlds together."""


def record(
    recipe: RecordRecipe,
    out: Path,
    *,
    tables: Mapping[str, Any],
    most_worlds: int = EVERY_CORE,
    cluster: UnitMap | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Recorded:
    """Record `recipe.episodes` successful demonstrations into the folder `out`.

    `tables` is the whole recipe file; each recording keeps it, so that `convert` knows what to do with it.
    Worlds run in parallel, one a core, `most_worlds` at the most, or on the machines of a `cluster`; what is
    recorded does not depend on where, nor on how many.
    Failed attempts are counted and not kept; a recording has the number of its attempt. Episodes that are finished
    stay whatever happens to the rest.

    Raises `OutputError` when `out` holds something already, `LfdError` when too many attempts fail.
    """
    check_output(out, overwrite=overwrite)
    robot = load_robot(recipe.robot)  # names that are unknown show before anything is touched
    load_task(recipe.task)
    check_expert(recipe.task)
    if cluster is None:
        most = min(most_worlds, recipe.episodes)
        worlds = make_worlds(recipe.task, recipe.robot, recipe.control_hz, most=most, progress=progress)
        for world in worlds:
            _take_cameras(world, recipe)
    else:
        worlds = []
    out.mkdir(parents=True, exist_ok=True)
    for old in (*out.glob(f"*{SUFFIX}"), *out.glob(f"*{SUFFIX}.part")):
        old.unlink()
    used = {**tables, "record": as_table(recipe)}
    write_manifest(out, kind="recordings", recipe=used, parents={}, seed=recipe.seed)
    began, tally = time.perf_counter(), _Tally(recipe.episodes, recipe.attempts_per_episode * recipe.episodes)
    if cluster is None:
        ended = _attempt(worlds, recipe, used, tally.next_attempt, out)
    else:
        ended = _attempt_on(cluster, robot, recipe, used, tally, out)
    with progress(f"record {recipe.task}", recipe.episodes) as bar:
        for outcome in ended:
            tally.end(outcome)
            rate = tally.steps / (time.perf_counter() - began)
            bar.advance(int(outcome.success), note=f"{tally.failed} failed, {rate:.0f} steps/s")
    if tally.kept < recipe.episodes:
        raise LfdError(f"{tally.failed} of {tally.attempts} attempts failed; {tally.kept} demonstrations are in {out}")
    rate = tally.steps / (time.perf_counter() - began)
    return Recorded(tally.kept, tally.failed, tally.steps, tally.clipped, round(rate, 1))


def _attempt(
    worlds: Sequence[World],
    recipe: RecordRecipe,
    used: Mapping[str, Any],
    next_attempt: Callable[[], int | None],
    out: Path,
) -> Iterator[Outcome]:
    """Make attempts as long as there is a next one; what succeeds is recorded into the folder `out`."""
    policies = [_demonstrator(world, recipe) for world in worlds]

    def next_start() -> Start | None:
        attempt = next_attempt()
        if attempt is None:
            return None
        origin = Origin(stage=STAGE, policy=policies[0].name, seed=recipe.seed, index=attempt, recipe=used)
        recorder = McapRecorder(out / f"episode_{attempt:06d}{SUFFIX}", origin, keep_failures=False)
        return Start(index=attempt, rng=episode_rng(STAGE, recipe.seed, attempt), observers=[recorder])

    ended = rollouts(
        worlds,
        OneEach(policies),
        next_start,
        horizon=round(recipe.max_seconds * recipe.control_hz),
        hold_steps=max(1, round(recipe.hold_seconds * recipe.control_hz)),
    )
    for _, outcome in ended:
        yield outcome


def _attempt_on(
    cluster: UnitMap, robot: RobotConfig, recipe: RecordRecipe, used: Mapping[str, Any], tally: "_Tally", out: Path
) -> Iterator[Outcome]:
    """Make attempts on a cluster, round by round as many as are still missing; recordings come back as bytes."""
    while needed := list(iter(tally.next_attempt, None)):
        units = [needed[unit.start : unit.stop] for unit in batches(len(needed), cluster.cpus)]
        for _, (outcomes, files) in cluster(_unit, (robot, recipe, used), units):
            unpack(files, out)
            yield from outcomes


def _unit(
    shared: tuple[RobotConfig, RecordRecipe, Mapping[str, Any]], attempts: Sequence[int]
) -> tuple[list[Outcome], dict[str, bytes]]:
    """A worker's part of a recording: outcomes, and recordings by name."""
    robot, recipe, used = shared
    world, waiting = kept_world(recipe.task, recipe.robot, robot, recipe.control_hz), iter(attempts)
    _take_cameras(world, recipe)
    with TemporaryDirectory() as folder:
        outcomes = list(_attempt([world], recipe, used, lambda: next(waiting, None), Path(folder)))
        return outcomes, packed(Path(folder))


@dataclass
class _Tally:
    """Counts attempts, and says when another one is needed.

    One is, when those that run would not be enough even if all of them succeed. Which attempts are made does
    therefore not depend on how many run at a time.
    """

    wanted: int
    most: int
    attempts: int = 0
    kept: int = 0
    failed: int = 0
    steps: int = 0
    clipped: int = 0

    def next_attempt(self) -> int | None:
        if self.attempts - self.failed >= self.wanted or self.attempts >= self.most:
            return None
        self.attempts += 1
        return self.attempts - 1

    def end(self, outcome: Outcome) -> None:
        self.steps, self.clipped = self.steps + outcome.steps, self.clipped + outcome.clipped
        self.kept, self.failed = self.kept + outcome.success, self.failed + (not outcome.success)


def _take_cameras(world: RobosuiteWorld, recipe: RecordRecipe) -> None:
    if recipe.cameras and world.spec.cameras != recipe.cameras:
        world.take_cameras(recipe.cameras, height=recipe.camera_height, width=recipe.camera_width)


def _demonstrator(world: World, recipe: RecordRecipe) -> Policy:
    expert = make_expert(world.spec)
    return NoisyPolicy(expert, scale=recipe.action_noise) if recipe.action_noise > 0 else expert
