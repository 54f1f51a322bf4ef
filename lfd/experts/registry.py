"""The scripted experts by task, and the devices by which a person demonstrates."""

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Policy, WorldSpec
from lfd.experts.device import Device, WithKeyboard
from lfd.experts.door import DoorExpert
from lfd.experts.lift import LiftExpert
from lfd.experts.nut_assembly_square import NutAssemblySquareExpert
from lfd.experts.pick_place_can import PickPlaceCanExpert
from lfd.experts.stack import StackExpert
from lfd.experts.style import PLAIN, ExpertStyle
from lfd.experts.tool_hang import ToolHangExpert
from lfd.experts.two_arm_lift import TwoArmLiftExpert
from lfd.experts.wipe import WipeExpert

EXPERTS: dict[str, Callable[[WorldSpec, ExpertStyle], Policy]] = {
    "Door": DoorExpert,
    "Lift": LiftExpert,
    "NutAssemblySquare": NutAssemblySquareExpert,
    "PickPlaceCan": PickPlaceCanExpert,
    "Stack": StackExpert,
    "ToolHang": ToolHangExpert,
    "TwoArmLift": TwoArmLiftExpert,
    "Wipe": WipeExpert,
}


def check_expert(task: str) -> None:
    """Raise `UnknownName` for a task that has no expert."""
    if task not in EXPERTS:
        raise UnknownName("task of a scripted expert", task, EXPERTS)


def make_expert(spec: WorldSpec, style: ExpertStyle = PLAIN) -> Policy:
    """The expert for a world's task.

    Raises `UnknownName` for a task that has none.
    """
    check_expert(spec.task)
    return EXPERTS[spec.task](spec, style)


def _keyboard() -> AbstractContextManager[Device]:
    if sys.platform == "win32":
        raise InputError("keys are read from a POSIX terminal: run lfd on Linux or macOS, or in WSL")
    from lfd.experts.keyboard import open_keyboard

    return open_keyboard()


def _spacemouse() -> AbstractContextManager[Device]:
    from lfd.experts.spacemouse import open_spacemouse

    return open_spacemouse()


def _gamepad() -> AbstractContextManager[Device]:
    if sys.platform != "linux":
        raise InputError(
            f"gamepads are read through Linux' input events, this is {sys.platform}; use --device keyboard"
        )
    from lfd.experts.gamepad import open_gamepad

    return open_gamepad()


DEVICES: dict[str, Callable[[], AbstractContextManager[Device]]] = {
    "keyboard": _keyboard,
    "spacemouse": _spacemouse,
    "gamepad": _gamepad,
}
"""Each module is imported when its device is opened: the libraries are not on every platform."""


@contextmanager
def open_device(name: str) -> Iterator[Device]:
    """A device by its name, together with the keyboard of this terminal, which says the words that it cannot.

    Raises `UnknownName` for a name that is no device, `InputError` when it is not there or may not be read.
    """
    if name not in DEVICES:
        raise UnknownName("device", name, DEVICES)
    if name == "keyboard":
        with _keyboard() as keyboard:
            yield keyboard
    else:
        with DEVICES[name]() as device, _keyboard() as keyboard:
            yield WithKeyboard(device, keyboard)
