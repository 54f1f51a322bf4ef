"""A sitting of comparisons: how it begins, and the reward that it ends with."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.artifact import sha256
from lfd.core.protocols import Progress, silent
from lfd.loops.comparing import Comparison, Rules, no_answers_yet
from lfd.loops.comparison_folder import Folder
from lfd.loops.comparison_pictures import plan_clip, posterior_picture
from lfd.loops.comparison_pool import make_pool
from lfd.loops.comparison_result import plan_for, regret, report
from lfd.replay.rerun_scene import replay
from lfd.rewards.factors import check_features
from lfd.rewards.reward_artifact import load_reward


def begin(
    out: Path,
    source: Path,
    rules: Rules,
    *,
    features: Sequence[str] | None = None,
    plans: int,
    reward: Path | None = None,
    overrides: Sequence[str] = (),
    overwrite: bool = False,
    progress: Progress = silent,
) -> Folder:
    """The folder of a new comparison of the pool that `source` gives (`lfd.loops.comparison_pool.make_pool`).

    It begins with what `reward` knows, if given, and asks about its features. Raises `OutputError` when `out` exists.
    """
    old = None if reward is None else load_reward(reward)
    if old is not None and features is not None:
        check_features(features, old.features, "--features")
    pool, parents = make_pool(
        source,
        features=features if old is None else old.features,
        size=plans,
        seed=rules.seed,
        overrides=overrides,
        progress=progress,
    )
    if reward is not None:
        parents = parents | {str(reward): sha256(reward)}
    folder = Folder(out, parents, Comparison(pool, no_answers_yet(pool) if old is None else old, rules))
    folder.begin(overwrite=overwrite)
    return folder


def finish(folder: Folder, *, ended: str, truth: Float[np.ndarray, "K"] | None = None) -> dict[str, Any]:
    """The report of a comparison that `ended`, with which its folder becomes a reward's.

    `truth` are the weights of a simulated person, if it was one.
    """
    comparison, out = folder.comparison, folder.path
    pool, reward = comparison.pool, comparison.reward()
    plan = plan_for(pool, reward.weights, scene=0, seed=comparison.rules.seed)
    found = report(comparison, reward, plan, ended=ended, truth=truth)
    if truth is not None:
        found["regret"] = regret(pool, plan, scene=0)
    clip, shapes = plan_clip(pool, plan, 0)
    replay(clip, save=out / "plan.rrd", overwrite=True, shapes=shapes)
    folder.end(
        ended=ended,
        also={
            "plan.rrd": (out / "plan.rrd").read_bytes(),
            "report.json": json.dumps(found, indent=2).encode(),
            "posterior.png": posterior_picture(comparison, reward, truth=truth, aligned=found.get("alignment", [])),
        },
    )
    return found
