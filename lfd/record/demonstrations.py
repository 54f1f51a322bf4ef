"""The record stage: demonstrations of a task, as many as the recipe asks for, one file each."""

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lfd.core.artifact import check_output, packed, read_manifest, unpack, write_manifest
from lfd.core.errors import LfdError, OutputError, RecipeError
from lfd.core.protocols import Observers, Policy, Progress, UnitMap, World, batches, silent, unwatched
from lfd.core.recipe import as_table
from lfd.experts.noise import NoisyPolicy
from lfd.experts.registry import check_expert, make_expert
from lfd.experts.style import ExpertStyle
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.journal import SUFFIX as JOURNAL
from lfd.record.mcap_file import SUFFIX
from lfd.worlds.robosuite_world import EVERY_CORE, RobosuiteWorld, kept_world, make_worlds
from lfd.worlds.robots import RobotConfig, load_robot
from lfd.worlds.rollout import OneEach, Outcome, Start, episode_rng, rollouts
from lfd.worlds.tasks import load_task

STAGE = "record"
EPISODE = "episode_"
"""What names of recordings begin with, before the number of the attempt."""
MAY_GROW = ("episodes", "attempts_per_episode")
"""Keys of the recipe that may differ when a recording is gone on with."""


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
    expert_speed: tuple[float, ...] = (1.0, 1.0)
    """Lowest and highest speed of the scripted expert, as a fraction of the full action; drawn for each episode."""
    expert_approach: str = "nearest"
    """From which side the scripted expert grasps: nearest, or any (drawn for each episode)."""
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

        self.style.check(where)

    @property
    def style(self) -> ExpertStyle:
        """How the scripted expert goes about the task."""
        return ExpertStyle(speed=self.expert_speed, approach=self.expert_approach)

    @property
    def horizon(self) -> int:
        """Control steps after which a demonstration has failed."""
        return round(self.max_seconds * self.control_hz)

    @property
    def hold_steps(self) -> int:
        """Control steps for which the task must stay solved."""
        return max(1, round(self.hold_seconds * self.control_hz))


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
    observers: Observers = unwatched,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Recorded:
    """Record `recipe.episodes` successful demonstrations into the folder `out`.

    `tables` is the whole recipe file; each recording keeps it, so that `convert` knows what to do with it.
    Worlds run in parallel, one a core, `most_worlds` at the most, or on the machines of a `cluster`; what is
    recorded does not depend on where, nor on how many. `observers` gives what else watches an attempt, where it runs
    in this process.
    Failed attempts are counted and not kept; a recording has the number of its attempt. Episodes that are finished
    stay whatever happens to the rest; with `resume` those in `out` are not recorded again, and the folder ends as if
    it had never been interrupted.

    Raises `OutputError` when `out` holds something already, or was recorded by another recipe, `LfdError` when too many
    attempts fail.
    """
    there = attempts_in(out, recipe, [key for key in as_table(recipe) if key not in MAY_GROW]) if resume else []
    if not resume:
        check_output(out, overwrite=overwrite)
    robot = load_robot(recipe.robot)  # names that are unknown show before anything is touched
    load_task(recipe.task)
    check_expert(recipe.task)
    if cluster is None:
        most = min(most_worlds, recipe.episodes)
        worlds = make_worlds(recipe.task, recipe.robot, recipe.control_hz, most=most, progress=progress)
        for world in worlds:
            take_cameras(world, recipe)
    else:
        worlds = []
    used = {**tables, "record": as_table(recipe)}
    if not resume:
        begin_recordings(out, used, recipe.seed)
    most_attempts = recipe.attempts_per_episode * recipe.episodes
    began, tally = time.perf_counter(), _Tally(recipe.episodes, most_attempts, frozenset(there))
    if cluster is None:
        ended = _attempt(worlds, recipe, used, tally.next_attempt, out, observers)
    else:
        ended = _attempt_on(cluster, robot, recipe, used, tally, out)
    with progress(f"record {recipe.task}", recipe.episodes) as bar:
        bar.advance(len(there), note=f"{len(there)} were there")
        for outcome in ended:
            tally.end(outcome)
            rate = tally.steps / (time.perf_counter() - began)
            bar.advance(int(outcome.success), note=f"{tally.failed} failed, {rate:.0f} steps/s")
    if tally.kept < recipe.episodes:
        raise LfdError(f"{tally.failed} of {tally.attempts} attempts failed; {tally.kept} demonstrations are in {out}")
    rate = tally.steps / (time.perf_counter() - began)
    return Recorded(tally.kept, tally.failed, tally.steps, tally.clipped, round(rate, 1))


def attempts_in(out: Path, recipe: RecordRecipe, same: Sequence[str]) -> list[int]:
    """Numbers of the attempts that are recorded in a folder which is to be gone on with.

    Raises `OutputError` when it holds none, or when they were made by a recipe that differs in one of the keys `same`.
    """
    manifest = read_manifest(out) if out.is_dir() else None
    if manifest is None:
        raise OutputError(f"{out} holds no recordings to go on with; leave --resume out to begin there")
    before, now = manifest["recipe"].get("record", {}), as_table(recipe)
    for key in same:
        if before.get(key) != now[key]:
            raise OutputError(
                f"{out} was recorded with {key} = {before.get(key)!r}, the recipe says {now[key]!r}; "
                "go on with the same recipe, or choose another --out"
            )
    return numbers_in(out, "$")


def numbers_in(out: Path, ending: str) -> list[int]:
    """Numbers of the recordings in a folder whose names end in a pattern after `.mcap`."""
    names = (re.match(rf"{EPISODE}(\d+){re.escape(SUFFIX)}{ending}", path.name) for path in out.iterdir())
    return sorted(int(name[1]) for name in names if name)


def begin_recordings(out: Path, used: Mapping[str, Any], seed: int) -> None:
    """Make `out` an empty folder of recordings; `used` is the recipe as it is used."""
    out.mkdir(parents=True, exist_ok=True)
    for old in (p for ending in ("", ".part", JOURNAL) for p in out.glob(f"*{SUFFIX}{ending}")):
        old.unlink()
    write_manifest(out, kind="recordings", recipe=used, parents={}, seed=seed)


def make_recorder(
    out: Path, used: Mapping[str, Any], *, policy: str, seed: int, attempt: int, keep_failures: bool
) -> McapRecorder:
    """What records attempt number `attempt` of a policy into the folder `out`."""
    origin = Origin(stage=STAGE, policy=policy, seed=seed, index=attempt, recipe=used)
    return McapRecorder(out / f"{EPISODE}{attempt:06d}{SUFFIX}", origin, keep_failures=keep_failures)


def _attempt(
    worlds: Sequence[World],
    recipe: RecordRecipe,
    used: Mapping[str, Any],
    next_attempt: Callable[[], int | None],
    out: Path,
    observers: Observers = unwatched,
) -> Iterator[Outcome]:
    """Make attempts as long as there is a next one; what succeeds is recorded into the folder `out`."""
    policies = [_demonstrator(world, recipe) for world in worlds]

    def next_start() -> Start | None:
        attempt = next_attempt()
        if attempt is None:
            return None
        recorder = make_recorder(
            out, used, policy=policies[0].name, seed=recipe.seed, attempt=attempt, keep_failures=False
        )
        rng = episode_rng(STAGE, recipe.seed, attempt)
        return Start(index=attempt, rng=rng, observers=[recorder, *observers(attempt)])

    ended = rollouts(worlds, OneEach(policies), next_start, horizon=recipe.horizon, hold_steps=recipe.hold_steps)
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
    take_cameras(world, recipe)
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
    there: frozenset[int] = frozenset()
    """Attempts that succeeded before."""
    attempts: int = 0
    kept: int = 0
    failed: int = 0
    steps: int = 0
    clipped: int = 0

    def next_attempt(self) -> int | None:
        while self.attempts - self.failed < self.wanted and self.attempts < self.most:
            self.attempts += 1
            if self.attempts - 1 not in self.there:
                return self.attempts - 1
            self.kept += 1
        return None

    def end(self, outcome: Outcome) -> None:
        self.steps, self.clipped = self.steps + outcome.steps, self.clipped + outcome.clipped
        self.kept, self.failed = self.kept + outcome.success, self.failed + (not outcome.success)


def take_cameras(world: RobosuiteWorld, recipe: RecordRecipe) -> None:
    """Have a world take the pictures that a recipe asks for."""
    if recipe.cameras and world.spec.cameras != recipe.cameras:
        world.take_cameras(recipe.cameras, height=recipe.camera_height, width=recipe.camera_width)


def _demonstrator(world: World, recipe: RecordRecipe) -> Policy:
    expert = make_expert(world.spec, recipe.style)
    return (
        NoisyPolicy(expert, world.spec.labels["action"], scale=recipe.action_noise)
        if recipe.action_noise > 0
        else expert
    )
