"""The scripted experts by task."""

from collections.abc import Callable

from lfd.core.errors import UnknownName
from lfd.core.protocols import Policy, WorldSpec
from lfd.experts.lift import LiftExpert

EXPERTS: dict[str, Callable[[WorldSpec], Policy]] = {
    "Lift": LiftExpert,
}


def make_expert(spec: WorldSpec) -> Policy:
    """The expert for a world's task.

    Raises `UnknownName` for a task that has none.
    """
    if spec.task not in EXPERTS:
        raise UnknownName("task of a scripted expert", spec.task, EXPERTS)
    return EXPERTS[spec.task](spec)
