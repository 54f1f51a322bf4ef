"""What a comparison ends with: the plan that the answers imply, and a report."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.loops.comparing import Comparison, alignments
from lfd.loops.comparison_pool import DEMONSTRATOR, Pool
from lfd.loops.reward_judging import costs
from lfd.planning.arm_planner import Plan
from lfd.rewards.reward_artifact import LinearReward, weight_table


def plan_for(pool: Pool, weights: Float[np.ndarray, "K"], *, scene: int, seed: int) -> Plan:
    """The best plan for some weights in a scene of the pool, from its best trajectory there and random starts."""
    rng, inside = np.random.default_rng([8, seed]), np.flatnonzero(pool.scene_of == scene)
    returns = pool.counts[inside] @ np.append(weights, pool.recipe.smoothness)
    warm = pool.trajectories[inside[int(returns.argmax())]]
    return pool.planner(scene).plan(weights, warm=warm, starts=pool.recipe.starts, rng=rng)


def report(
    comparison: Comparison, reward: LinearReward, plan: Plan, *, ended: str, truth: Float[np.ndarray, "K"] | None
) -> dict[str, Any]:
    """How the questions ended, what is known of w, what the plan is like; `truth` is a simulated person's w, if any."""
    belief = comparison.belief()
    found: dict[str, Any] = {
        "answers": len(comparison.answers),
        "ended": ended,
        "consistency": belief.consistency,
        "expected_bits": [answer.question.bits for answer in comparison.answers],
        "weights": weight_table(reward),
        "plan": {name: float(f) for name, f in zip(reward.features, plan.features, strict=True)},
        "plan_clearance_m": plan.clearance,
    }
    if truth is not None:
        found["alignment"] = alignments(comparison, truth)
    return found


def regret(pool: Pool, plan: Plan, *, scene: int) -> float | None:
    """What a plan costs more than the demonstrator's by the demonstrator's own weights, as a share; None without one.

    Only for simulated people, who have these weights.
    """
    own = [i for i in np.flatnonzero(pool.scene_of == scene) if pool.names[i] == DEMONSTRATOR]
    if not own:
        return None
    recipe, judge = pool.recipe, pool.planner(scene, pool.recipe.features)
    both = np.stack([plan.trajectory, pool.trajectories[own[0]]])
    ours, best = costs(judge, recipe.weights, recipe.smoothness, both)
    return float((ours - best) / abs(best))


def shown(found: Mapping[str, Any]) -> dict[str, Any]:
    """A report as lines of a table."""
    told: dict[str, Any] = {"answers": f"{found['answers']}: {found['ended']}"}
    told["consistency"] = (
        f"{found['consistency']:.1%} is the mean chance of the answers; 50% is guessing, and the most for equal ones"
    )
    for name, row in found["weights"].items():
        told[name] = (
            f"{row['weight']:.4g} +- {row['spread']:.2g} {row['unit']}, {row['per_range']:.3g} +- "
            f"{row['per_range_spread']:.2g} over its range; plan: {found['plan'][name]:.4g}"
        )
    if "alignment" in found:
        told["alignment"] = f"{found['alignment'][-1]:.3f} with the simulated person's weights (only used here)"
    if found.get("regret") is not None:
        told["regret"] = f"{found['regret']:.1%}: what the plan costs more than the person's own best, by their weights"
    return told
