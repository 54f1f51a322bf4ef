"""Where in a message a number stands: `pose.position`, `data[0:7]`, `poses[1].orientation.w`."""

import re
import sys
from collections.abc import Sequence

from lfd.core.errors import RecipeError

Step = str | int | slice
"""A member's name, an index of an array, or a part of an array."""

_PART = re.compile(r"([^.\[\]]+)(?:\[(\d+)\]|\[(\d*):(\d*)\])?")


def parse_field(field: str, where: str) -> tuple[Step, ...]:
    """The steps that lead to `field`; none for the whole message.

    Raises `RecipeError` for what is no path.
    """
    steps: list[Step] = []
    for part in field.split(".") if field else ():
        found = _PART.fullmatch(part)
        if found is None or (steps and isinstance(steps[-1], slice)):
            raise RecipeError(
                f"{where} field = {field!r} is no path; write it like pose.position, poses[0].orientation or data[0:7]"
            )
        name, index, begin, end = found.groups()
        steps.append(name)
        if index is not None:
            steps.append(int(index))
        elif begin is not None:
            steps.append(slice(int(begin or 0), int(end) if end else None))
    return tuple(steps)


def members_of(path: Sequence[Step]) -> str:
    """The path without its indices: `poses.orientation`."""
    return ".".join(step for step in path if isinstance(step, str))


def meet(a: Sequence[Step], b: Sequence[Step]) -> bool:
    """Whether two paths have a number in common; a path stands for everything below it."""
    return all(_steps_meet(x, y) for x, y in zip(a, b, strict=False))


def _steps_meet(a: Step, b: Step) -> bool:
    if isinstance(a, str) or isinstance(b, str):
        return a == b
    (a_begin, a_end), (b_begin, b_end) = _span(a), _span(b)
    return max(a_begin, b_begin) < min(a_end, b_end)


def _span(step: int | slice) -> tuple[int, int]:
    if isinstance(step, int):
        return step, step + 1
    return step.start, sys.maxsize if step.stop is None else step.stop
