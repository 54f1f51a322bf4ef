"""Plans of a learned reward beside the demonstrations that it was learned from."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lfd.core.artifact import read_manifest
from lfd.core.errors import InputError
from lfd.loops.arm_evidence import Evidence, load_evidence, resampled
from lfd.loops.comparison_pool import DEMONSTRATOR, load_pool, shown_in
from lfd.loops.comparison_pool import FILE as POOL
from lfd.planning.kinematics import GRIPPER, forward
from lfd.planning.signed_distances import Shape
from lfd.replay.clip import Clip, clip_of
from lfd.rewards.reward_artifact import FILE as REWARD


def demonstrations_of(reward: Path) -> Path:
    """The recordings or the dataset that a reward was learned from, as its manifest names them; other rewards and
    recipes that it names are none.

    Raises `InputError` when the manifest names none or it is gone.
    """
    parents = list((read_manifest(reward) or {}).get("parents", {}))
    places = (Path(), *reward.resolve().parents)
    there = [place / parent for parent in parents for place in places if (place / parent).exists()]
    found = [path for path in there if path.suffix != ".toml" and not (path / REWARD).is_file()]
    if not found:
        told = f"{parents[0]} is gone" if parents else "its manifest.json names none"
        raise InputError(f"no demonstrations of {reward}: {told}; name some with --beside RECORDINGS")
    return found[0]


def shown_for(reward: Path, beside: Path | None) -> Evidence:
    """Demonstrations in whose scenes a reward plans: those in `beside`, else those that it was learned from, else the
    demonstrator's plan of the pool that it was compared with.

    Raises `InputError` when there are none of these.
    """
    pool = load_pool(reward) if beside is None and (reward / POOL).is_file() else None
    if pool is not None and DEMONSTRATOR in pool.names:
        return shown_in(pool)
    return load_evidence(beside or demonstrations_of(reward))


def clip_beside(plans: Path, episode: int, shown: Evidence) -> tuple[Clip, tuple[Shape, ...]]:
    """The recording of a plan as a clip with the paths of the demonstrations of its scene, and the scene's shapes."""
    clip, planned = clip_of(plans, episode), load_evidence(plans).demonstrations[episode]
    paths = {
        f"demonstration_{number}": forward(shown.arm, resampled(one.trajectory, len(clip.times))).points[:, GRIPPER]
        for number, one in enumerate(shown.demonstrations)
        if one.placement == planned.placement
    }
    return replace(clip, positions={**clip.positions, **paths}), planned.placement.scene(shown.arm).shapes


def compared(plans: Path, shown: Evidence) -> dict[str, str]:
    """Mean feature counts of plans, and of the demonstrations in their scenes."""
    planned, features = load_evidence(plans), shown.recipe.features
    scenes = {one.placement for one in planned.demonstrations}
    beside = replace(shown, demonstrations=tuple(d for d in shown.demonstrations if d.placement in scenes))
    ours, theirs = (np.mean(evidence.counts(features), axis=0) for evidence in (planned, beside))
    return {f: f"{a:.4g} planned, {b:.4g} demonstrated" for f, a, b in zip(features, ours, theirs, strict=True)}
