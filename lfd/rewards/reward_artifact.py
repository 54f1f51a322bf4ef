"""A linear reward as an artifact: `reward.json` beside a manifest, complete enough to plan with.

    R(tau) = w . f(tau)

f are the feature counts of `lfd.rewards.arm_features`. What evidence changed the weights, and from what to what, is
kept as history: rewards are learned from demonstrations, then from comparisons and corrections.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.artifact import new_folder, write_json, write_manifest
from lfd.core.errors import InputError
from lfd.rewards.arm_features import arm_features

KIND, FILE = "reward", "reward.json"


@dataclass(frozen=True)
class Change:
    """An entry of the history: some evidence, and what it did to the weights."""

    evidence: str
    """What was learned from, in words."""
    before: tuple[float, ...]
    """Weights before; empty where there were none."""
    after: tuple[float, ...]
    """Weights after."""


@dataclass(frozen=True, kw_only=True)
class LinearReward:
    """Weights of features, and the planner's settings that they were learned for.

    Raises `UnknownName` for a feature that lfd does not know, `InputError` for lengths that differ, numbers that are
    not finite, and ranges that are not positive.
    """

    features: tuple[str, ...]
    """Names of features (`lfd.rewards.ARM_FEATURES`)."""
    weights: Float[np.ndarray, "_"]
    """w, K numbers: reward for each unit of a feature count [1/(unit s)]."""
    ranges: Float[np.ndarray, "_"]
    """By how much each feature count varies between trajectories [unit s]: weights times ranges compare features."""
    robot: str
    """Name of the robot config."""
    waypoints: int
    """Of a plan."""
    duration_s: float
    """Of a plan [s]; feature counts are integrals over it."""
    smoothness: float
    """lambda of the planner's prior [s^3/rad^2]: part of what the weights mean, as it sets their scale."""
    method: str
    """How the weights came about, such as maxent; `given` by a person."""
    measures: Mapping[str, float] = field(default_factory=dict)
    """What the method says of its result: margin, slack, log-likelihood and so on."""
    covariance: Float[np.ndarray, "_ _"] | None = None
    """Of the weights, where the method has a posterior."""
    history: tuple[Change, ...] = ()
    """What changed the weights, the oldest first."""

    def __post_init__(self) -> None:
        arm_features(self.features)
        count = len(self.features)
        shapes = {"weights": (count,), "ranges": (count,), "covariance": (count, count)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is None:
                continue
            if values.shape != shape or not np.isfinite(values).all():
                raise InputError(
                    f"{name} have shape {values.shape} or are not finite; {count} features need {shape}: "
                    f"{', '.join(self.features)}"
                )
            values.setflags(write=False)
        if not (self.ranges > 0).all():
            raise InputError(f"ranges = {self.ranges}: each must be positive; leave out a feature that never varies")

    @property
    def units(self) -> tuple[str, ...]:
        """Of the feature counts."""
        return tuple(f"{feature.unit} s" for feature in arm_features(self.features))

    def changed(self, weights: Float[np.ndarray, "K"], evidence: str, **others: Any) -> "LinearReward":
        """The reward after some evidence, which is noted in the history; `others` are fields that change with it."""
        entry = Change(evidence, tuple(map(float, self.weights)), tuple(map(float, weights)))
        return replace(self, weights=np.array(weights, dtype=float), history=(*self.history, entry), **others)


def save_reward(
    reward: LinearReward,
    out: Path,
    *,
    recipe: Mapping[str, Any],
    parents: Mapping[str, str],
    seed: int,
    overwrite: bool = False,
    also: Mapping[str, bytes] | None = None,
) -> None:
    """Write the folder `out`; `parents` maps what the reward was learned from to its hash, `also` names other files.

    Raises `OutputError` when `out` exists or cannot be written.
    """
    content = {f.name: _plain(getattr(reward, f.name)) for f in fields(reward)} | {"units": list(reward.units)}
    with new_folder(out, overwrite=overwrite) as part:
        write_json(part / FILE, content)
        for name, data in (also or {}).items():
            (part / name).write_bytes(data)
        write_manifest(part, kind=KIND, recipe=recipe, parents=parents, seed=seed, method=reward.method)


def load_reward(folder: Path) -> LinearReward:
    """The reward in a folder that `save_reward` wrote.

    Raises `InputError` when there is none, when it is no JSON, lacks a key or has one too many, and what `LinearReward`
    raises.
    """
    path = folder / FILE
    if not path.is_file():
        raise InputError(f"{folder} holds no {FILE}; `lfd irl METHOD --dataset RECORDINGS --out {folder}` learns one")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is no JSON ({error}); learn the reward again") from error
    known = {f.name for f in fields(LinearReward)} | {"units"}
    if not isinstance(content, dict) or set(content) != known:
        keys = set(content) if isinstance(content, dict) else set()
        raise InputError(
            f"{path} is no reward: missing {sorted(known - keys)}, unknown {sorted(keys - known)}; learn it again"
        )
    units = content.pop("units")
    try:
        arrays: dict[str, np.ndarray | None] = {k: np.array(content[k], dtype=float) for k in ("weights", "ranges")}
        covariance = content["covariance"]
        history = tuple(Change(c["evidence"], tuple(c["before"]), tuple(c["after"])) for c in content["history"])
        arrays["covariance"] = None if covariance is None else np.array(covariance, dtype=float)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{path} has something else than numbers where they belong ({error}); learn it again"
        ) from error
    reward = LinearReward(**{**content, **arrays, "features": tuple(content["features"]), "history": history})
    if tuple(units) != reward.units:
        raise InputError(
            f"{path} has weights for feature counts in {', '.join(units)}, in this lfd they are in "
            f"{', '.join(reward.units)}; learn the reward again"
        )
    return reward


def _plain(value: Any) -> Any:
    """A field as JSON has it."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return vars(value) if isinstance(value, Change) else dict(value) if isinstance(value, Mapping) else value
