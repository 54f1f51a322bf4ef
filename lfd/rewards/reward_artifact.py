"""A linear reward as an artifact: `reward.json` beside a manifest, complete enough to plan with.

    R(tau) = w . f(tau)

f are the feature counts of `lfd.rewards.arm_features`. What evidence changed the weights, and from what to what, is
kept as history: rewards are learned from demonstrations, comparisons and corrections, in any order. Each entry has the
factor of p(w) that it is, so that the history is the belief (`lfd.reward_learning.weight_belief`).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.artifact import new_folder, write_json, write_manifest
from lfd.core.errors import InputError
from lfd.rewards.arm_features import arm_features
from lfd.rewards.factors import Factor, GaussianFactor, check_size, factor_of, factor_table

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
    factor: Factor | None = None
    """The evidence as a factor of p(w); None where a method has none: what was known before is forgotten then."""


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
    """How the first weights came about, such as maxent; `given` by a person."""
    measures: Mapping[str, float] = field(default_factory=dict)
    """What that method says of its result: margin, slack, log-likelihood and so on."""
    covariance: Float[np.ndarray, "_ _"] | None = None
    """Of the weights, where there is a posterior: of its Laplace approximation."""
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
        for change in self.history:
            if change.factor is not None:
                check_size(change.factor, self.features, change.evidence)

    @property
    def units(self) -> tuple[str, ...]:
        """Of the feature counts."""
        return tuple(f"{feature.unit} s" for feature in arm_features(self.features))

    def begun(self) -> "LinearReward":
        """The reward with a history: where it has none, that its weights were given, with their covariance if any."""
        if self.history:
            return self
        spread = self.covariance
        factor = None if spread is None else GaussianFactor.about(self.weights, spread)
        entry = Change(f"weights as they were ({self.method})", (), tuple(map(float, self.weights)), factor)
        return replace(self, history=(entry,))

    def changed(
        self,
        weights: Float[np.ndarray, "K"],
        evidence: str,
        factor: Factor | None,
        *,
        covariance: Float[np.ndarray, "K K"] | None,
    ) -> "LinearReward":
        """The reward after some evidence, which is noted in the history; the planner's settings stay."""
        entry = Change(evidence, tuple(map(float, self.weights)), tuple(map(float, weights)), factor)
        history = (*self.begun().history, entry)
        return replace(self, weights=np.array(weights, dtype=float), covariance=covariance, history=history)

    def undone(self) -> "LinearReward":
        """The reward without its last change, and without a covariance: `lfd.reward_learning.undone` knows it.

        Raises `InputError` when there is no change but the one that it began with.
        """
        if len(self.history) < 2:
            first = self.history[0].evidence if self.history else "nothing"
            raise InputError(f"nothing to undo: the history has only what the reward began with ({first})")
        weights = np.array(self.history[-1].before)
        return replace(self, weights=weights, covariance=None, history=self.history[:-1])


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
    with new_folder(out, overwrite=overwrite) as part:
        write_json(part / FILE, reward_table(reward))
        for name, data in (also or {}).items():
            (part / name).write_bytes(data)
        write_manifest(part, kind=KIND, recipe=recipe, parents=parents, seed=seed, method=reward.method)


def load_reward(folder: Path) -> LinearReward:
    """The reward in a folder that `save_reward` wrote.

    Raises `InputError` when there is none, when it is no JSON, and what `reward_of` raises.
    """
    path = folder / FILE
    if not path.is_file():
        raise InputError(f"{folder} holds no {FILE}; `lfd irl METHOD --dataset RECORDINGS --out {folder}` learns one")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is no JSON ({error}); learn the reward again") from error
    return reward_of(content, str(path))


def weight_table(reward: LinearReward) -> dict[str, dict[str, Any]]:
    """Each feature's weight with its unit, the same over the feature's range, and their spread; None where unknown."""
    spread = np.full(len(reward.weights), np.nan) if reward.covariance is None else np.sqrt(np.diag(reward.covariance))
    rows = zip(reward.features, reward.units, reward.weights, spread, reward.ranges, strict=True)
    return {
        name: {
            "weight": float(w),
            "spread": None if np.isnan(s) else float(s),
            "unit": f"1/({unit})",
            "per_range": float(w * r),
            "per_range_spread": None if np.isnan(s) else float(s * r),
        }
        for name, unit, w, s, r in rows
    }


def reward_table(reward: LinearReward) -> dict[str, Any]:
    """A reward as JSON has it."""
    content = {f.name: _plain(getattr(reward, f.name)) for f in fields(reward)}
    return content | {"units": list(reward.units), "history": [_entry(change, reward) for change in reward.history]}


def reward_of(table: Any, where: str) -> LinearReward:
    """The reward that `reward_table` wrote; `where` begins its errors.

    Raises `InputError` when it lacks a key or has one too many, for other units, and what `LinearReward` raises.
    """
    known = {f.name for f in fields(LinearReward)} | {"units"}
    if not isinstance(table, dict) or set(table) != known:
        keys = set(table) if isinstance(table, dict) else set()
        raise InputError(
            f"{where} is no reward: missing {sorted(known - keys)}, unknown {sorted(keys - known)}; learn it again"
        )
    content = dict(table)
    units = content.pop("units")
    try:
        arrays: dict[str, np.ndarray | None] = {k: np.array(content[k], dtype=float) for k in ("weights", "ranges")}
        covariance = content["covariance"]
        history = tuple(_change(entry, content["features"], where) for entry in content["history"])
        arrays["covariance"] = None if covariance is None else np.array(covariance, dtype=float)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{where} has something else than numbers where they belong ({error}); learn it again"
        ) from error
    reward = LinearReward(**{**content, **arrays, "features": tuple(content["features"]), "history": history})
    if tuple(units) != reward.units:
        raise InputError(
            f"{where} has weights for feature counts in {', '.join(units)}, in this lfd they are in "
            f"{', '.join(reward.units)}; learn the reward again"
        )
    return reward


def _entry(change: Change, reward: LinearReward) -> dict[str, Any]:
    """An entry of the history as JSON has it."""
    factor = None if change.factor is None else factor_table(change.factor, reward.features)
    return {**vars(change), "before": list(change.before), "after": list(change.after), "factor": factor}


def _change(entry: Mapping[str, Any], features: Sequence[str], where: str) -> Change:
    """The entry of the history that `_entry` wrote."""
    if "factor" not in entry:
        raise InputError(
            f"{where} was written before histories kept the evidence itself, so that nothing can be added to it or "
            "undone; learn it again, `lfd irl METHOD --dataset RECORDINGS --out DIR`"
        )
    table = entry["factor"]
    factor = None if table is None else factor_of(table, features, f"{where}, {entry['evidence']!r}")
    return Change(entry["evidence"], tuple(entry["before"]), tuple(entry["after"]), factor)


def _plain(value: Any) -> Any:
    """A field as JSON has it, but for the history."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return dict(value) if isinstance(value, Mapping) else value
