"""The eval stage: a policy's success over start states that no demonstration began at."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfd.core.artifact import new_folder, sha256, write_json, write_manifest
from lfd.core.errors import RecipeError
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import as_table
from lfd.policies.acting import LearnedPolicy, about_policy
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.mcap_file import SUFFIX
from lfd.run.wilson import wilson_interval
from lfd.worlds.robosuite_world import make_world
from lfd.worlds.rollout import episode_rng, rollout

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
    seed: int
    seconds: float
    """Wall time [s]."""
    per_episode: tuple[dict[str, Any], ...]
    """Index, success, steps and reward of each episode."""


def evaluate(
    policy: Path, recipe: EvalRecipe, out: Path, *, overwrite: bool = False, progress: Progress = silent
) -> Report:
    """Run a policy from `recipe.episodes` start states; recordings and the report land in the folder `out`.

    Raises `PolicyError` for a policy that cannot be loaded, `OutputError` when `out` exists.
    """
    about = about_policy(policy)
    used = {**about["recipe"], "eval": as_table(recipe)}
    began, rows = time.perf_counter(), []
    with new_folder(out, overwrite=overwrite) as part:
        with progress("build world", 1) as bar:
            world = make_world(about["task"], about["robot"], about["control_hz"])
            learned = LearnedPolicy(policy, world.spec)
            bar.advance()
        (part / "episodes").mkdir()
        with progress(f"evaluate {about['task']}", recipe.episodes) as bar:
            for index in range(recipe.episodes):
                origin = Origin(stage=STAGE, policy=learned.name, seed=recipe.seed, index=index, recipe=used)
                path = part / "episodes" / f"episode_{index:06d}{SUFFIX}"
                outcome = rollout(
                    world,
                    learned,
                    [McapRecorder(path, origin, keep_failures=True)],
                    episode_rng(STAGE, recipe.seed, index),
                    horizon=round(recipe.max_seconds * about["control_hz"]),
                    hold_steps=max(1, round(recipe.hold_seconds * about["control_hz"])),
                )
                rows.append({"index": index, **asdict(outcome)})
                bar.advance(note=f"{sum(row['success'] for row in rows)} of {len(rows)} solved")
        successes = sum(row["success"] for row in rows)
        report = Report(
            success_rate=successes / len(rows),
            interval=wilson_interval(successes, len(rows)),
            successes=successes,
            episodes=len(rows),
            mean_steps=float(np.mean([row["steps"] for row in rows])),
            seed=recipe.seed,
            seconds=time.perf_counter() - began,
            per_episode=tuple(rows),
        )
        write_json(part / REPORT, asdict(report))
        write_manifest(
            part, kind="evaluation", recipe=used, parents={str(policy): sha256(policy)}, seed=recipe.seed,
            task=about["task"], robot=about["robot"], policy=about["policy"],
        )  # fmt: skip
    return report
