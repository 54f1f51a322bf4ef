"""What a learned reward is worth: how its plans fare under the weights of the demonstrator, in scenes held out.

    regret = (cost of the learned reward's plan - mean cost of the demonstrations) / |mean cost of the demonstrations|,
    cost = -w* . f + prior, with the demonstrator's w* and the planner's prior

Only a planned demonstrator's weights are known, and they are used for nothing but this.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.loops.arm_evidence import Evidence
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.trajectory_costs import rest_to_rest
from lfd.rewards.reward_artifact import LinearReward

JUDGE_STREAM = 3
"""Part of the seed of plans that are judged."""


@dataclass(frozen=True)
class Regret:
    """Over the scenes held out."""

    mean: float
    worst: float
    scenes: int


def split(evidence: Evidence, held_out: int) -> tuple[Evidence, Evidence]:
    """Evidence to learn from, and that of the last `held_out` scenes. Raises `InputError` when nothing is left."""
    scenes = [placement for placement, _ in evidence.scenes]
    if not 0 <= held_out < len(scenes):
        raise InputError(f"there are {len(scenes)} scenes: {held_out} cannot be held out; --holdout takes fewer")
    kept = set(scenes[: len(scenes) - held_out])
    parts = [tuple(d for d in evidence.demonstrations if (d.placement in kept) == is_kept) for is_kept in (True, False)]
    return replace(evidence, demonstrations=parts[0]), replace(evidence, demonstrations=parts[1])


def regret(reward: LinearReward, held_out: Evidence, *, seed: int) -> Regret:
    """How much more the reward's plans cost than the demonstrations in each of some scenes."""
    recipe, found = held_out.recipe, []
    for number, (placement, demonstrations) in enumerate(held_out.scenes):
        rng = np.random.default_rng([JUDGE_STREAM, seed, number])
        plan = held_out.planner(placement, reward.features).plan(reward.weights, starts=recipe.starts, rng=rng)
        judge = held_out.planner(placement, recipe.features)
        ours, theirs = (
            costs(judge, recipe.weights, recipe.smoothness, t) for t in (plan.trajectory[None], demonstrations)
        )
        found.append(float((ours[0] - theirs.mean()) / abs(theirs.mean())))
    return Regret(float(np.mean(found)), max(found), len(found))


def costs(
    planner: ArmPlanner, weights: Sequence[float], smoothness: float, trajectories: Float[np.ndarray, "B T D"]
) -> Float[np.ndarray, "B"]:
    """-w . f and the prior of some trajectories."""
    matrix = smoothness * rest_to_rest(planner.waypoints, planner.dt_s)
    prior = 0.5 * np.einsum("btd,ts,bsd->b", trajectories, matrix, trajectories)
    return prior - planner.features(trajectories) @ np.array(weights)
