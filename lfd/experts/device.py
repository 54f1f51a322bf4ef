"""A person's device, whatever it is: where it is pushed and turned to, and what was said with its buttons."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lfd.experts.keys import AXES, Word


@dataclass(frozen=True, kw_only=True)
class DeviceState:
    """What a device says at one time, in the directions of `lfd.experts.keys.AXES`."""

    translation: Float[np.ndarray, "3"]
    """Deflection along x (away from the person), y (left) and z (up), in [-1, 1]."""
    rotation: Float[np.ndarray, "3"]
    """Deflection about the same axes, right-handed, in [-1, 1]."""
    words: tuple[Word, ...] = ()
    """Words since the last reading, in the order in which they were said."""


def pushed(pushes: Iterable[tuple[str, float]], words: Iterable[Word]) -> DeviceState:
    """The state of a device whose parts each push along an axis by a number; pushes along the same axis add up."""
    deflection = dict.fromkeys(AXES, 0.0)
    for axis, amount in pushes:
        deflection[axis] += amount
    values = np.clip(np.array(list(deflection.values())), -1.0, 1.0)
    return DeviceState(translation=values[:3], rotation=values[3:], words=tuple(words))


@runtime_checkable
class Device(Protocol):
    """What a person moves a robot with."""

    name: str

    def read(self) -> DeviceState:
        """The present state; never waits. Raises `LfdError` when the device is gone."""
        ...


class WithKeyboard:
    """A device together with the keyboard, which says the words that the device has no buttons for."""

    def __init__(self, device: Device, keyboard: Device):
        self.name = device.name
        self._device, self._keyboard = device, keyboard

    def read(self) -> DeviceState:
        state = self._device.read()
        return replace(state, words=state.words + self._keyboard.read().words)
