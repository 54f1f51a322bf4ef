"""What the page says of the person's keys and gamepad, some forty times a second, and what of it is believed.

    {"hello": {"tab": TAB, "seat": SEAT}}                      once, and again after a reconnection
    {"n": N, "keys": [KEY...], "said": [KEY...], "pad": {"axes": [X...], "buttons": [X...]} | null, "late": [MS...]}

`keys` are held down now, `said` went down since the last message, `late` are latencies that the page has measured: from
an event to the news that a control step has taken it in. A message without change is the sign that the page is there.
"""

import json
from dataclasses import dataclass
from math import isfinite
from typing import Any

from lfd.core.errors import InputError

LONGEST = 4096
"""Bytes of a message."""
MOST_KEYS, MOST_AXES, MOST_BUTTONS, MOST_LATE = 20, 8, 32, 50
LONGEST_KEY, LONGEST_NAME = 16, 64
LARGEST = 1.01
"""Of an axis or a button; gamepads overshoot 1 by rounding."""


@dataclass(frozen=True)
class Hello:
    """Who is there."""

    tab: str
    """A name that the tab of the browser chose, and keeps when it is loaded again."""
    seat: str
    """The name that the console gave to the scene's connection of the same page."""


@dataclass(frozen=True)
class Pad:
    """A gamepad in the standard layout of browsers."""

    axes: tuple[float, ...]
    """In [-1, 1]: left stick to the right and towards the person, right stick likewise."""
    buttons: tuple[float, ...]
    """In [0, 1]."""


@dataclass(frozen=True)
class Input:
    """What is held down, and what was pressed."""

    number: int
    keys: tuple[str, ...] = ()
    said: tuple[str, ...] = ()
    pad: Pad | None = None
    late_ms: tuple[float, ...] = ()


def parse(text: str | bytes) -> Hello | Input:
    """A message of the page. Raises `InputError` for anything else."""
    if not isinstance(text, str) or len(text) > LONGEST:
        raise InputError(f"a message is text of at most {LONGEST} characters")
    try:
        told = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"a message is JSON: {error}") from error
    if not isinstance(told, dict):
        raise InputError("a message is an object")
    if "hello" in told:
        hello = told["hello"] if isinstance(told["hello"], dict) else {}
        return Hello(_name(hello.get("tab"), "tab"), _name(hello.get("seat"), "seat"))
    number = told.get("n")
    if type(number) is not int or not 0 <= number < 2**53:
        raise InputError("n counts messages")
    return Input(
        number,
        _keys(told.get("keys", []), "keys"),
        _keys(told.get("said", []), "said"),
        _pad(told.get("pad")),
        _numbers(told.get("late", []), "late", MOST_LATE, 0.0, 1e6),
    )


def _name(value: Any, what: str) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= LONGEST_NAME or not value.isprintable():
        raise InputError(f"{what} is a name of 1 to {LONGEST_NAME} characters")
    return value


def _keys(value: Any, what: str) -> tuple[str, ...]:
    if not isinstance(value, list) or len(value) > MOST_KEYS:
        raise InputError(f"{what} lists at most {MOST_KEYS} keys")
    for key in value:
        if not isinstance(key, str) or not 0 < len(key) <= LONGEST_KEY:
            raise InputError(f"{what} lists names of keys")
    return tuple(value)


def _pad(value: Any) -> Pad | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise InputError("pad has axes and buttons")
    axes = _numbers(value.get("axes", []), "axes", MOST_AXES, -LARGEST, LARGEST)
    return Pad(axes, _numbers(value.get("buttons", []), "buttons", MOST_BUTTONS, 0.0, LARGEST))


def _numbers(value: Any, what: str, most: int, low: float, high: float) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) > most:
        raise InputError(f"{what} lists at most {most} numbers")
    for number in value:
        if type(number) not in (int, float) or not isfinite(number) or not low <= number <= high:
            raise InputError(f"{what} lists numbers from {low:g} to {high:g}")
    return tuple(map(float, value))
