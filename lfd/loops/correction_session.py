"""A sitting of corrections, from what a robot believes to the reward that it has learned, as a folder.

The folder has the recordings, and as `reward` the reward with its picture of the weights and a report.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfd.core.artifact import new_folder, sha256, write_manifest
from lfd.core.protocols import Observer, Policy, Progress, silent
from lfd.core.recipe import as_table
from lfd.experts.pushing import Person
from lfd.loops.correcting import (
    CorrectionRecipe,
    Setup,
    correct,
    learned_reward,
    learner_of,
    make_correction_world,
    report_of,
    weights_by_push,
)
from lfd.loops.correction_results import weights_picture
from lfd.rewards.reward_artifact import LinearReward, save_reward


@dataclass(frozen=True)
class Seat:
    """Who pushes, and what their being a person takes."""

    pushes: Person
    observers: Callable[[], list[Observer]] = list
    """Of each run: what shows it to them."""
    around: Callable[[Policy], Policy] = lambda policy: policy
    """Put around the policy, as `lfd.record.pacing.Paced` is for people."""
    has_known_weights: bool = False
    """Whether what they want is known, and what was learned can be judged by it."""


def correct_into(
    out: Path,
    recipe: CorrectionRecipe,
    setup: Setup,
    reward: LinearReward,
    seat: Seat,
    *,
    parents: Mapping[str, str],
    overwrite: bool = False,
    progress: Progress = silent,
) -> tuple[dict[str, Any], LinearReward]:
    """The report and the learned reward of a recipe's runs, which begin with `reward`; all is in `out` then.

    `parents` are the path and hash of where the reward came from, if from anywhere. Raises `OutputError` when `out`
    exists, `InputError` for a reward that does not fit the recipe, and what `lfd.loops.correcting.correct` raises.
    """
    learner = learner_of(reward, recipe)
    with new_folder(out, overwrite=overwrite) as part:
        runs = correct(
            recipe,
            setup,
            learner,
            seat.pushes,
            make_correction_world(recipe),
            out=part / "recordings",
            observers=seat.observers,
            around=seat.around,
            progress=progress,
        )
        weights = weights_by_push(runs, reward.weights)
        report = report_of(recipe, setup, runs, weights, judged=seat.has_known_weights)
        learned = learned_reward(reward, learner)
        save_reward(
            learned,
            part / "reward",
            recipe={"task": recipe.task, "rule": recipe.rule, "step": recipe.step},
            parents={str(out / "recordings"): sha256(part / "recordings"), **parents},
            seed=recipe.seed,
            also={
                "weights.png": weights_picture(weights, learned),
                "report.json": json.dumps(report, indent=2).encode(),
            },
        )
        write_manifest(
            part, kind="corrections", recipe={"correct": as_table(recipe)}, parents=parents, seed=recipe.seed
        )
    return report, learned
