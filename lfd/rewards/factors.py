"""Evidence about reward weights, each piece a factor of p(w): what histories of rewards keep.

    U(tau) = w.f(tau) - lambda E(tau)           what a person wants, with the planner's prior E, whose lambda is known

    GaussianFactor    log p = -1/2 (w - m)^T P (w - m)                 demonstrations; weights that a person gave
    PushFactor        log p = w.d,  d = f(tau_H) - f(tau_R)            a physical correction
    ChoiceFactor      p(a) = 1 / (1 + exp(-rationality (w.d + o)))     "A or B?", d = f_A - f_B, o = -lambda (E_A - E_B)

each up to a constant. A factor holds K numbers in the order of its reward's features; in files it names them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError, UnknownName
from lfd.rewards.checked_arrays import finite_array

Choice = Literal["a", "b", "equal"]
CHOICES: tuple[Choice, ...] = get_args(Choice)
ROUNDING = 1e-8
"""Asymmetry of a precision, and how negative it may be, in units of its diagonal."""


@dataclass(frozen=True, eq=False)
class GaussianFactor:
    """A normal density of w. Raises `InputError` for other shapes, numbers that are not finite, or no precision."""

    mean: Float[np.ndarray, "_"]
    """m, K numbers [1/(unit s)]."""
    precision: Float[np.ndarray, "_ _"]
    """P, the inverse of the covariance, K by K; it may be singular where this evidence says nothing."""

    def __post_init__(self) -> None:
        mean = _kept(self, "mean", ("K",))
        precision = _kept(self, "precision", (len(mean), len(mean)))
        sizes = np.sqrt(np.maximum(np.diag(precision), 0.0))
        units = np.where(sizes > 0.0, sizes, 1.0)
        scaled = precision / np.outer(units, units)
        if np.abs(scaled - scaled.T).max() > ROUNDING or np.linalg.eigvalsh(scaled).min() < -ROUNDING * len(mean):
            raise InputError("precision is no inverse covariance: it must be symmetric and have no negative eigenvalue")

    @classmethod
    def about(cls, mean: Float[np.ndarray, "K"], covariance: Float[np.ndarray, "K K"]) -> "GaussianFactor":
        """N(mean, covariance). Raises `InputError` for a covariance that is not positive definite."""
        units = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        try:
            root = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(units, units)))
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"the covariance of the weights {mean} is not positive definite; learn them again"
            ) from error
        root = root / units
        return cls(mean, root.T @ root)


@dataclass(frozen=True, eq=False)
class PushFactor:
    """A push, by the Laplace approximation of `correction_update`. Raises `InputError` as `GaussianFactor` does."""

    difference: Float[np.ndarray, "_"]
    """d, K numbers [unit s], times the confidence in this correction: f(tau_H) - f(tau_R)."""

    def __post_init__(self) -> None:
        _kept(self, "difference", ("K",))


@dataclass(frozen=True, eq=False)
class ChoiceFactor:
    """An answer to "which of the two do you like better?".

    Raises `InputError` for numbers that are not finite, a rationality that is not positive, and a trajectory compared
    with one of the same features; `UnknownName` for another choice.
    """

    difference: Float[np.ndarray, "_"]
    """d = f_A - f_B, K numbers [unit s]."""
    offset: float
    """o = -lambda (E_A - E_B): what A is better by for the planner's prior, whatever the weights."""
    choice: str
    """What the person prefers, one of `CHOICES`; about "equal" counts as half an answer each way."""
    rationality: float
    """Factor on the difference in U; the larger, the fewer mistakes the person makes."""

    def __post_init__(self) -> None:
        difference = _kept(self, "difference", ("K",))
        if self.choice not in CHOICES:
            raise UnknownName("choice", self.choice, CHOICES)
        if not np.isfinite(self.offset):
            raise InputError(f"offset = {self.offset}: must be a finite number")
        if not (np.isfinite(self.rationality) and self.rationality > 0.0):
            raise InputError(f"rationality = {self.rationality}: give a positive number")
        if not difference.any():
            raise InputError(
                "the difference is 0: a trajectory compared with one of the same features says nothing about w; ask "
                "for another pair"
            )


Factor = GaussianFactor | PushFactor | ChoiceFactor
KINDS: dict[str, type[Factor]] = {"gaussian": GaussianFactor, "push": PushFactor, "choice": ChoiceFactor}


def factor_size(factor: Factor) -> int:
    """K, the number of weights that a factor is about."""
    return len(factor.mean) if isinstance(factor, GaussianFactor) else len(factor.difference)


def factor_table(factor: Factor, features: Sequence[str]) -> dict[str, Any]:
    """A factor as JSON has it, with the names of the features that its numbers are about."""
    kind = next(name for name, known in KINDS.items() if isinstance(factor, known))
    plain = {key: v.tolist() if isinstance(v, np.ndarray) else v for key, v in vars(factor).items()}
    return {"kind": kind, "features": list(features), **plain}


def factor_of(table: Mapping[str, Any], features: Sequence[str], where: str) -> Factor:
    """The factor that `factor_table` wrote, for a reward with these features; `where` begins its errors.

    Raises `InputError` for other features or another order of them, keys that are missing or unknown, and what the
    factors raise.
    """
    if not isinstance(table, Mapping) or table.get("kind") not in KINDS:
        raise InputError(f"{where} is no factor: its kind must be one of {', '.join(KINDS)}")
    kind = KINDS[table["kind"]]
    wanted = {"kind", "features", *kind.__dataclass_fields__}
    if set(table) != wanted:
        missing, unknown = sorted(wanted - set(table)), sorted(set(table) - wanted)
        raise InputError(f"{where} is no {table['kind']} factor: missing {missing}, unknown {unknown}")
    check_features(table["features"], features, where)
    values = {key: table[key] for key in kind.__dataclass_fields__}
    try:
        arrays: dict[str, Any] = {k: np.array(v, dtype=float) if isinstance(v, list) else v for k, v in values.items()}
        casts = {"offset": float, "rationality": float, "choice": str}
        factor = kind(**{k: casts[k](v) if k in casts else v for k, v in arrays.items()})
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} has something else than numbers where they belong ({error})") from error
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    check_size(factor, features, where)
    return factor


def check_features(given: Sequence[str], expected: Sequence[str], where: str) -> None:
    """Refuse features of another number or order than a reward has: `InputError` with both."""
    if list(given) != list(expected):
        raise InputError(
            f"{where} has the features {', '.join(map(str, given))}, the reward has {', '.join(expected)}; both must "
            "have the same ones in the same order"
        )


def check_size(factor: Factor, features: Sequence[str], where: str) -> None:
    """Refuse a factor that is about another number of weights: `InputError` with both."""
    size = factor_size(factor)
    if size != len(features):
        raise InputError(f"{where} has {size} numbers, expected {len(features)}, one for each of {', '.join(features)}")


def _kept(factor: Any, name: str, shape: Sequence[int | str]) -> Float[np.ndarray, "..."]:
    """An array of a factor, checked, and from now on its own and read-only."""
    array = finite_array(name, getattr(factor, name), shape).copy()
    array.setflags(write=False)
    object.__setattr__(factor, name, array)
    return array
