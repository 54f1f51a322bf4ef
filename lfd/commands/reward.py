"""Commands on a reward itself: what is known of its weights, what changed them, and taking that back.

They import their stage when they run, so that `lfd --help` answers at once.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from lfd.commands.options import Commands, Result
from lfd.core.errors import InputError

ACTIONS = ("show", "history", "undo")
STALE, STALE_KINDS = ("report.json", "comparing.json"), (".png", ".rrd")
"""Files of a reward that tell of the weights before an undo, or would go on from them: they go with them."""


def add(commands: Commands) -> None:
    """The command of this module."""
    made = commands.add(
        "reward",
        run_reward,
        "what is known of a learned reward (show), what changed it (history), and taking the last change back (undo)",
        "lfd reward show outputs/reward",
    )
    made.epilog += "\n         lfd reward undo outputs/reward --out outputs/before"
    made.add_argument("action", choices=ACTIONS, help="what to do")
    made.add_argument("reward", type=Path, metavar="REWARD", help="folder of a learned reward")
    made.add_argument("--out", type=Path, metavar="NEW", help="folder for what undo leaves (default: in place)")
    made.add_argument("--overwrite", action="store_true", help="replace --out if it exists")


def run_reward(given: Namespace) -> Result:
    """What was asked for."""
    if given.action != "undo" and (given.out is not None or given.overwrite):
        raise InputError(f"--out and --overwrite are for undo; `lfd reward {given.action}` writes nothing")
    return {"show": _show, "history": _history, "undo": _undo}[given.action](given)


def _show(given: Namespace) -> Result:
    """Weights with units and spread, how well evidence agrees, where it comes from."""
    from collections import Counter

    from lfd.core.artifact import read_manifest
    from lfd.reward_learning.weight_belief import belief_of
    from lfd.rewards.factors import KINDS
    from lfd.rewards.reward_artifact import load_reward, weight_table

    reward, manifest = load_reward(given.reward), read_manifest(given.reward) or {}
    belief = belief_of(reward)
    kinds = Counter(next(n for n, kind in KINDS.items() if isinstance(f, kind)) for f in belief.factors)
    consistency = belief.consistency if kinds["choice"] else None
    about = {
        "method": reward.method,
        "robot": reward.robot,
        "planner": {"waypoints": reward.waypoints, "duration_s": reward.duration_s, "smoothness": reward.smoothness},
        "evidence": dict(kinds),
        "changes": len(reward.history),
        "made": manifest.get("made"),
        "learned_from": list(manifest.get("parents", {})),
    }
    if given.json:
        return {"weights": weight_table(reward), "consistency": consistency, **about}
    told: Result = {name: weight_line(row) for name, row in weight_table(reward).items()}
    if consistency is not None:
        told["consistency"] = (
            f"{consistency:.1%} is the mean chance of the answers; 50% is guessing, and the most for equal ones"
        )
    return {**told, **about}


def weight_line(row: dict[str, Any]) -> str:
    """A weight as a line of a table."""
    if row["spread"] is None:
        return f"{row['weight']:.4g} {row['unit']}, {row['per_range']:.3g} over its range; no spread is known"
    return (
        f"{row['weight']:.4g} +- {row['spread']:.2g} {row['unit']}, "
        f"{row['per_range']:.3g} +- {row['per_range_spread']:.2g} over its range"
    )


def _history(given: Namespace) -> Result:
    """Each change: the evidence, the weights before and after."""
    from lfd.rewards.reward_artifact import load_reward

    reward = load_reward(given.reward)
    changes = reward.begun().history
    if given.json:
        rows = [{"evidence": c.evidence, "before": list(c.before), "after": list(c.after)} for c in changes]
        return {"features": list(reward.features), "changes": rows}
    lines = []
    for number, change in enumerate(changes):
        lines.append(f"{number}  {change.evidence}")
        for k, name in enumerate(reward.features):
            before = f"{change.before[k]:.4g} -> " if change.before else ""
            lines.append(f"     {name:<24} {before}{change.after[k]:.4g} 1/({reward.units[k]})")
    return {"lines": lines}


def _undo(given: Namespace) -> Result:
    """The reward without its last change, in its place or in another folder."""
    from lfd.core.artifact import check_output, read_manifest, sha256
    from lfd.reward_learning.weight_belief import undone
    from lfd.rewards.reward_artifact import FILE, load_reward, save_reward, weight_table

    place: Path = given.reward if given.out is None else given.out
    if given.out is not None:
        check_output(given.out, overwrite=given.overwrite)
    reward, manifest = load_reward(given.reward), read_manifest(given.reward) or {}
    before, last = undone(reward), reward.history[-1].evidence
    parents: dict[str, str] = dict(manifest.get("parents", {}))
    if given.out is not None:
        parents[str(given.reward)] = sha256(given.reward)
    kept = {
        file.name: file.read_bytes()
        for file in given.reward.iterdir()
        if file.is_file() and file.name not in (FILE, "manifest.json", *STALE) and file.suffix not in STALE_KINDS
    }
    recipe: dict[str, Any] = dict(manifest.get("recipe", {}))
    recipe["undone"] = [*recipe.get("undone", []), last]
    save_reward(
        before,
        place,
        recipe=recipe,
        parents=parents,
        seed=int(manifest.get("seed", 0)),
        overwrite=given.out is None or given.overwrite,
        also=kept,
    )
    rows = weight_table(before)
    told: Result = {"weights": rows} if given.json else {name: weight_line(row) for name, row in rows.items()}
    return {"out": str(place), "undone": last, **told}
