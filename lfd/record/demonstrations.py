"""The record stage: demonstrations of a task, as many as the recipe asks for, one file each."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfd.core.artifact import check_output, write_manifest
from lfd.core.errors import LfdError, RecipeError
from lfd.core.protocols import Policy, Progress, silent
from lfd.core.recipe import as_table
from lfd.experts.noise import NoisyPolicy
from lfd.experts.registry import make_expert
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.worlds.robosuite_world import make_world
from lfd.worlds.rollout import episode_rng, rollout

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
    attempts_per_episode: int = 3
    """Recording gives up after this many attempts for each demonstration asked for."""

    def check(self, where: str) -> None:
        positive = ("control_hz", "episodes", "max_seconds", "hold_seconds", "attempts_per_episode")
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


def record(
    recipe: RecordRecipe,
    out: Path,
    *,
    tables: Mapping[str, Any],
    overwrite: bool = False,
    progress: Progress = silent,
) -> Recorded:
    """Record `recipe.episodes` successful demonstrations into the folder `out`.

    `tables` is the whole recipe file; each recording keeps it, so that `convert` knows what to do with it.
    Failed attempts are counted and not kept. Episodes that are finished stay whatever happens to the rest.

    Raises `OutputError` when `out` holds something already, `LfdError` when too many attempts fail.
    """
    check_output(out, overwrite=overwrite)
    with progress("build world", 1) as bar:  # the first time on a machine, the control step is compiled
        world = make_world(recipe.task, recipe.robot, recipe.control_hz)
        bar.advance()
    policy: Policy = make_expert(world.spec)
    if recipe.action_noise > 0:
        policy = NoisyPolicy(policy, scale=recipe.action_noise)
    out.mkdir(parents=True, exist_ok=True)
    for old in (*out.glob(f"*{SUFFIX}"), *out.glob(f"*{SUFFIX}.part")):
        old.unlink()
    used = {**tables, "record": as_table(recipe)}
    write_manifest(out, kind="recordings", recipe=used, parents={}, seed=recipe.seed)
    kept = steps = attempt = 0
    with progress(f"record {recipe.task}", recipe.episodes) as bar:
        while kept < recipe.episodes:
            if attempt >= recipe.attempts_per_episode * recipe.episodes:
                raise LfdError(f"{attempt - kept} of {attempt} attempts failed; {kept} demonstrations are in {out}")
            origin = Origin(stage=STAGE, policy=policy.name, seed=recipe.seed, index=attempt, recipe=used)
            recorder = McapRecorder(out / f"episode_{kept:06d}{SUFFIX}", origin, keep_failures=False)
            outcome = rollout(
                world,
                policy,
                [recorder],
                episode_rng(STAGE, recipe.seed, attempt),
                horizon=round(recipe.max_seconds * recipe.control_hz),
                hold_steps=max(1, round(recipe.hold_seconds * recipe.control_hz)),
            )
            attempt += 1
            steps += outcome.steps
            if outcome.success:
                kept += 1
                bar.advance(note=f"{attempt - kept} failed")
    return Recorded(episodes=kept, failures=attempt - kept, steps=steps)
