"""The eval stage: a policy's success over start states that no demonstration began at."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lfd.core.artifact import new_folder, sha256, write_json, write_manifest
from lfd.core.errors import RecipeError
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import as_table
from lfd.policies.acting import AskedOnce, LearnedPolicy, about_policy
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.run.wilson import wilson_interval
from lfd.worlds.robosuite_world import EVERY_CORE, make_worlds
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
    overwrite: bool = False,
    progress: Progress = silent,
) -> Report:
    """Run a policy from `recipe.episodes` start states; recordings and the report land in the folder `out`.

    Worlds run in parallel, one a core, `most_worlds` at the most; the result does not depend on how many.
    Raises `PolicyError` for a policy that cannot be loaded, `OutputError` when `out` exists.
    """
    about = about_policy(policy)
    used = {**about["recipe"], "eval": as_table(recipe)}
    began = time.perf_counter()
    with new_folder(out, overwrite=overwrite) as part:
        (part / "episodes").mkdir()
        rows, stepping = run_episodes(
            policy, recipe, range(recipe.episodes), part / "episodes", most_worlds=most_worlds, progress=progress
        )
        report = make_report(rows, recipe, time.perf_counter() - began, stepping)
        write_json(part / REPORT, asdict(report))
        write_manifest(
            part, kind="evaluation", recipe=used, parents={str(policy): sha256(policy)}, seed=recipe.seed,
            task=about["task"], robot=about["robot"], policy=about["policy"],
        )  # fmt: skip
    return report


def run_episodes(
    policy: Path,
    recipe: EvalRecipe,
    indices: Sequence[int],
    episodes: Path,
    *,
    most_worlds: int,
    progress: Progress = silent,
) -> tuple[list[dict[str, Any]], float]:
    """Run the episodes of some numbers; their recordings land in the folder `episodes`.

    Returns a row for each, its index and its outcome, in the order of the numbers, and the wall time of the steps [s].
    """
    about = about_policy(policy)
    used = {**about["recipe"], "eval": as_table(recipe)}
    hz = about["control_hz"]
    worlds = make_worlds(about["task"], about["robot"], hz, most=min(most_worlds, len(indices)), progress=progress)
    learned = LearnedPolicy(policy, worlds[0].spec)

    def start(index: int) -> Start:
        origin = Origin(stage=STAGE, policy=learned.name, seed=recipe.seed, index=index, recipe=used)
        recorder = McapRecorder(episodes / f"episode_{index:06d}{SUFFIX}", origin, keep_failures=True)
        return Start(index=index, rng=episode_rng(STAGE, recipe.seed, index), observers=[recorder])

    waiting, rows = iter(indices), []
    ended = rollouts(
        worlds,
        AskedOnce(learned),
        lambda: next((start(index) for index in waiting), None),
        horizon=round(recipe.max_seconds * hz),
        hold_steps=max(1, round(recipe.hold_seconds * hz)),
    )
    began = time.perf_counter()
    with progress(f"evaluate {about['task']}", len(indices)) as bar:
        for begun, outcome in ended:
            rows.append({"index": begun.index, **asdict(outcome)})
            rate = sum(row["steps"] for row in rows) / (time.perf_counter() - began)
            bar.advance(note=f"{sum(row['success'] for row in rows)} of {len(rows)} solved, {rate:.0f} steps/s")
    return sorted(rows, key=lambda row: row["index"]), time.perf_counter() - began


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
