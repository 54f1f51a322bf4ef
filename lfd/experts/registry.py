"""The scripted experts by task."""

from collections.abc import Callable

from lfd.core.errors import UnknownName
from lfd.core.protocols import Policy, WorldSpec
from lfd.experts.lift import LiftExpert

EXPERTS: dict[str, Callable[[WorldSpec], Policy]] = {
    "Lift": LiftExpert,
}


def check_expert(task: str) -> None:
    """Raise `UnknownName` for a task that has no expert."""
    if task not in EXPERTS:
        raise UnknownName("task of a scripted expert", task, EXPERTS)


def make_expert(spec: WorldSpec) -> Policy:
    """The expert for a world's task.

    Raises `UnknownName` for a task that has none.
    """
    check_expert(spec.task)
    return EXPERTS[spec.task](spec)
