"""R_H of a type of people as an artifact: `person.json` beside a manifest."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfd.core.artifact import new_folder, write_json, write_manifest
from lfd.core.errors import InputError, UnknownName
from lfd.interaction import driving_irl, driving_model, table_irl, table_model

KIND, FILE = "person_reward", "person.json"
LEARN = "`lfd irl people --dataset RECORDINGS --type TYPE --out REWARD` learns one"


@dataclass(frozen=True)
class Learnable:
    """A type of people whose weights can be learned."""

    default: tuple[float, ...]
    """What robots take them for otherwise."""
    features: tuple[str, ...]
    """What the weights are of."""
    wide: tuple[float, ...]
    """Standard deviations of their prior."""


LEARNABLE = {
    **{name: Learnable(theta, driving_irl.FEATURES, driving_irl.WIDE) for name, theta in driving_model.TYPES.items()},
    **{
        manner: Learnable((weight,), table_irl.FEATURES, table_irl.WIDE)
        for manner, weight in table_model.MANNERS.items()
    },
}
"""By name."""


@dataclass(frozen=True, kw_only=True)
class PersonReward:
    """What one type of people is after."""

    type: str
    """Whose weights these are: passive or aggressive, yields or insists."""
    features: tuple[str, ...]
    weights: tuple[float, ...]
    """theta, or of people at the table its yielding."""
    spread: tuple[float, ...]
    """Standard deviation of each weight, by Laplace's approximation."""
    rationality: float
    """With which they choose: it sets the scale of the weights."""
    choices: int
    """How many were learned from."""
    log_likelihood: float
    """Mean of a choice that was learned from [nat]."""

    def __post_init__(self) -> None:
        if self.type not in LEARNABLE:
            raise UnknownName("type of person", self.type, LEARNABLE)
        expected = LEARNABLE[self.type].features
        if self.features != expected:
            raise InputError(f"features are {', '.join(self.features)}, expected {', '.join(expected)}; learn it again")
        numbers = np.array([*self.weights, *self.spread, self.rationality])
        if len(self.weights) != len(expected) or not np.isfinite(numbers).all() or min(self.weights) < 0.0:
            raise InputError(f"weights are {self.weights}: expected {len(expected)} numbers from 0 on; learn it again")


def save_person_reward(
    reward: PersonReward, out: Path, *, recipe: Mapping[str, Any], parents: Mapping[str, str], overwrite: bool
) -> None:
    """Write the folder `out`. Raises `OutputError` when it exists or cannot be written."""
    with new_folder(out, overwrite=overwrite) as part:
        write_json(part / FILE, asdict(reward))
        write_manifest(part, kind=KIND, recipe=recipe, parents=parents, seed=0)


def load_person_reward(folder: Path) -> PersonReward:
    """What `save_person_reward` wrote. Raises `InputError` when there is none, or something else."""
    path = folder / FILE
    if not path.is_file():
        raise InputError(f"{folder} holds no {FILE}; {LEARN}")
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        for name in ("features", "weights", "spread"):
            table[name] = tuple(table[name])
        return PersonReward(**table)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path} is no reward of people ({error}); {LEARN}") from error


def theta_of(rewards: Sequence[PersonReward], rationality: float) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """Type and theta of each, for robots that take people for choosing with this rationality.

    Raises `InputError` for a type that is given twice, or another rationality: what a crash counts for is not learned,
    so that theta cannot be scaled.
    """
    names = [reward.type for reward in rewards]
    if len(set(names)) < len(names):
        raise InputError(f"rewards are of {', '.join(names)} people: give one for each type")
    for reward in rewards:
        if reward.rationality != rationality:
            raise InputError(
                f"the reward of {reward.type} people was learned with rationality {reward.rationality:g}, robots take "
                f"people for choosing with {rationality:g}: learn it again with --rationality {rationality:g}"
            )
    return tuple((reward.type, reward.weights) for reward in rewards)
