"""The error tree.

`InputError` and below are the user's mistakes (exit code 2): the message says what was given, what was
expected and what to type next. Any other `LfdError` is a failure of the run itself (exit code 1).
"""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any


class LfdError(Exception):
    """Anything that lfd itself reports; the command line prints its message without a traceback."""


class SimulationError(LfdError):
    """The physics became unstable or a state cannot be restored."""


class VerificationError(LfdError):
    """Two things that must be equal are not: a dataset and its recordings, a replay and its recording."""


class TrainingError(LfdError):
    """Training cannot go on, for example because the loss is not finite."""


class InputError(LfdError):
    """The user's mistake."""


class UnknownName(InputError):
    """A name that does not exist; the message lists those that do."""

    def __init__(self, kind: str, given: str, known: Iterable[str], hint: str = ""):
        names = sorted(known)
        self._given = kind, given, names, hint
        close = get_close_matches(given, names, n=1)
        guess = f" Did you mean {close[0]!r}?" if close else ""
        tail = f" {hint}" if hint else ""
        super().__init__(f"unknown {kind} {given!r}; known: {', '.join(names)}.{guess}{tail}")

    def __reduce__(self) -> Any:  # errors come back from other processes
        return type(self), self._given


class RecipeError(InputError):
    """A recipe that cannot be used: not TOML, a missing or mistyped key, a value out of range."""


class EpisodeError(InputError):
    """Numbers that are no episode: NaN, lengths that differ, time that runs back."""


class RecordingError(InputError):
    """A recording that cannot be read: truncated, garbage, of another schema."""


class DatasetError(InputError):
    """A dataset folder that cannot be read or does not fit."""


class PolicyError(InputError):
    """A policy folder that cannot be loaded or does not fit the world."""


class OutputError(InputError):
    """An output place that exists already or cannot be written."""
