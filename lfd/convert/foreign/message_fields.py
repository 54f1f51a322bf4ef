"""What a decoded message says: its stamp, its frame, and the numbers of a field with their names."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Shaped

from lfd.convert.foreign.field_path import Step
from lfd.convert.foreign.mapping import QUATERNION
from lfd.convert.foreign.message_decoding import Decoder
from lfd.core.rotations import wxyz_from_xyzw

SECONDS = ("sec", "seconds", "secs")
NANOSECONDS = ("nanosec", "nsec", "nanos", "nsecs")
NAME_LISTS = ("name", "names", "joint_names")


def value_at(message: Any, decoder: Decoder, path: Sequence[Step]) -> Any:
    """What stands at a path.

    Raises `ValueError` for a member or index that does not exist; the sentence lists those that do.
    """
    value, walked = message, ""
    for step in path:
        if isinstance(step, str):
            members = decoder.members(value)
            if step not in members:
                has = f"it has {', '.join(members)}" if members else f"it is {_kind(value)}"
                raise ValueError(f"no field {step!r} in {walked or 'the message'}; {has}")
            value = getattr(value, step)
            walked = f"{walked}.{step}" if walked else step
        else:
            if not hasattr(value, "__len__") or isinstance(value, str):
                raise ValueError(f"{walked} is no array; it is {_kind(value)}")
            last = step if isinstance(step, int) else (step.stop or 0) - 1
            if last >= len(value):
                raise ValueError(f"{walked} has {len(value)} elements, element {last} was asked for")
            value = value[step]
    return value


def stamp_of(message: Any, decoder: Decoder) -> int:
    """The message's own stamp [ns]: `header.stamp`, `timestamp` or `stamp`; 0 where it has none."""
    members = decoder.members(message)
    inside = message.header if "header" in members else message
    for name in ("stamp", "timestamp"):
        if name in decoder.members(inside):
            time = getattr(inside, name)
            parts = decoder.members(time)
            seconds = [getattr(time, part) for part in SECONDS if part in parts]
            nanoseconds = [getattr(time, part) for part in NANOSECONDS if part in parts]
            if seconds and nanoseconds and all(isinstance(n, int) for n in (seconds[0], nanoseconds[0])):
                return seconds[0] * 10**9 + nanoseconds[0]
    return 0


def frame_of(message: Any, decoder: Decoder) -> str:
    """The message's `frame_id`; empty where it has none."""
    inside = message.header if "header" in decoder.members(message) else message
    frame = inside.frame_id if "frame_id" in decoder.members(inside) else ""
    return str(frame).removeprefix("/")


def numbers_at(message: Any, decoder: Decoder, path: Sequence[Step]) -> tuple[Shaped[np.ndarray, "D"], tuple[str, ...]]:
    """The numbers at a path and their names; no names where the message gives none. Quaternions become wxyz.

    Raises `ValueError` for what is no number, no array of numbers and no message of numbers.
    """
    value = value_at(message, decoder, path)
    members = decoder.members(value)
    if members:
        numbers = [getattr(value, member) for member in members]
        if not all(isinstance(number, int | float) for number in numbers):
            raise ValueError(f"it has the fields {', '.join(members)}; add one of them to the recipe's field")
        if members == (*QUATERNION[1:], QUATERNION[0]):
            return wxyz_from_xyzw(np.array(numbers, dtype=float)), QUATERNION
        return _array(numbers), members
    if isinstance(value, int | float):
        return _array([value]), _names(message, decoder, path) if path and isinstance(path[-1], int) else ()
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8).astype(float), _names(message, decoder, path)
    if isinstance(value, str) or not hasattr(value, "__len__"):
        raise ValueError(f"it is {_kind(value)}, no number")
    elements = list(value)
    if not all(isinstance(element, int | float) for element in elements):
        raise ValueError(f"it is an array of {_kind(elements[0])}; take one element, such as [0]")
    return _array(elements), _names(message, decoder, path)


def _array(numbers: list[Any]) -> Shaped[np.ndarray, "D"]:
    if numbers and all(isinstance(number, bool) for number in numbers):
        return np.array(numbers, dtype=bool)
    return np.array(numbers, dtype=float)


def _names(message: Any, decoder: Decoder, path: Sequence[Step]) -> tuple[str, ...]:
    """Names of an array's elements: a list of names beside it (JointState), or the label of its layout (MultiArray)."""
    whole = path if not path or isinstance(path[-1], str) else path[:-1]
    if not whole:
        return ()
    beside = value_at(message, decoder, whole[:-1])
    size = len(value_at(message, decoder, (*whole[:-1], whole[-1])))
    members = decoder.members(beside)
    found: list[str] = []
    for name in NAME_LISTS:
        if name in members and name != whole[-1]:
            found = [str(text) for text in getattr(beside, name)]
    if "layout" in members and len(beside.layout.dim) == 1:
        found = beside.layout.dim[0].label.split(",")
    if len(found) != size or len(set(found)) != size:
        return ()
    if isinstance(path[-1], str):
        return tuple(found)
    return (found[path[-1]],) if isinstance(path[-1], int) else tuple(found[path[-1]])


def _kind(value: Any) -> str:
    """A value's kind in words."""
    kinds = {str: "text", bytes: "bytes", bool: "a flag", int: "a number", float: "a number", type(None): "null"}
    return kinds.get(type(value), "an array" if hasattr(value, "__len__") else f"a {type(value).__name__}")
