"""Gamepads as a device, through Linux' input events. The only module that imports evdev.

Codes are those of the kernel's gamepad specification (Documentation/input/gamepad.rst). Stick axes grow to the right
and towards the person. The codes of the upper and left action button are not told apart: xpad, the driver of Xbox
pads, gives them the other way round.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import evdev
from evdev import AbsInfo, InputEvent, ecodes
from evdev.eventio import EventIO

from lfd.core.errors import InputError, LfdError
from lfd.experts.device import DeviceState, pushed
from lfd.experts.keys import Word

STICKS = {
    ecodes.ABS_Y: ("x", -1),
    ecodes.ABS_X: ("y", -1),
    ecodes.ABS_HAT0X: ("rx", 1),
    ecodes.ABS_RY: ("ry", -1),
    ecodes.ABS_RX: ("rz", -1),
}
"""Code of an axis that rests in its middle, to our axis and the direction along it."""
TRIGGERS = {ecodes.ABS_RZ: ("z", 1), ecodes.ABS_Z: ("z", -1)}
"""The same for axes that rest at their lowest value."""
BUTTONS: Mapping[int, tuple[Word, ...]] = {
    ecodes.BTN_SOUTH: (Word.GRIPPER,),
    ecodes.BTN_START: (Word.START, Word.SUCCESS),
    ecodes.BTN_EAST: (Word.FAILURE,),
    ecodes.BTN_NORTH: (Word.DISCARD,),
    ecodes.BTN_WEST: (Word.DISCARD,),
    ecodes.BTN_SELECT: (Word.REDO,),
    ecodes.BTN_MODE: (Word.QUIT,),
    ecodes.BTN_TL: (Word.SLOWER,),
    ecodes.BTN_TR: (Word.FASTER,),
}
"""Button to its words; at any time only one of start and success has a meaning."""
INPUTS = Path("/dev/input")


class Gamepad:
    """Turns input events into states. `axes` tells the present value and the range of every axis."""

    name = "gamepad"

    def __init__(self, events: EventIO, axes: Callable[[], Mapping[int, AbsInfo]]):
        self._events, self._axes = events, axes
        self._lost = False
        self._look()

    def read(self) -> DeviceState:
        words: list[Word] = []
        for event in self._arrived():
            words += self._take(event)
        return pushed(self._pushes(), words)

    def _pushes(self) -> Iterator[tuple[str, float]]:
        for code, (low, high) in self._ranges.items():
            way = (self._values[code] - low) / (high - low)  # 0 to 1
            if code in STICKS:
                axis, sign = STICKS[code]
                yield axis, sign * (2 * way - 1)
            elif code in TRIGGERS:
                axis, sign = TRIGGERS[code]
                yield axis, sign * way

    def _look(self) -> None:
        axes = self._axes()
        self._ranges = {code: (about.min, about.max) for code, about in axes.items() if about.max > about.min}
        self._values = {code: about.value for code, about in axes.items()}

    def _arrived(self) -> Iterator[InputEvent]:
        """The events that wait."""
        try:
            while True:
                yield from self._events.read()
        except BlockingIOError:  # evdev's word for none
            return
        except OSError as error:
            raise LfdError(f"the gamepad is gone ({error.strerror}); plug it in and go on with --resume") from error

    def _take(self, event: InputEvent) -> tuple[Word, ...]:
        """Keep what an event says of an axis; the words of a button that went down."""
        if event.type == ecodes.EV_SYN:
            if event.code == ecodes.SYN_DROPPED:
                self._lost = True
            elif self._lost:  # the kernel's queue was full: what it lost is seen by looking
                self._lost = False
                self._look()
        elif self._lost:
            pass  # the rest of a packet whose beginning is lost
        elif event.type == ecodes.EV_ABS:
            self._values[event.code] = event.value
        elif event.type == ecodes.EV_KEY and event.value == 1:
            return BUTTONS.get(event.code, ())
        return ()


@contextmanager
def open_gamepad() -> Iterator[Gamepad]:
    """The first gamepad that is plugged in.

    Raises `InputError` when there is none, or when it may not be read.
    """
    devices = [evdev.InputDevice(path) for path in sorted(evdev.list_devices())]
    try:
        pads = [device for device in devices if is_gamepad(device)]
        if not pads:
            raise InputError(_advice([device.name for device in devices]))
        pad = pads[0]
        codes = pad.capabilities(absinfo=False)[ecodes.EV_ABS]
        yield Gamepad(pad, lambda: {code: pad.absinfo(code) for code in codes})
    finally:
        for device in devices:
            device.close()


def is_gamepad(device: evdev.InputDevice) -> bool:
    """Whether an input device is what the kernel calls a gamepad, with a stick."""
    able = device.capabilities(absinfo=False)
    return ecodes.BTN_GAMEPAD in able.get(ecodes.EV_KEY, []) and ecodes.ABS_X in able.get(ecodes.EV_ABS, [])


def _advice(names: list[str]) -> str:
    closed = [path.name for path in sorted(INPUTS.glob("event*")) if not os.access(path, os.R_OK)]
    if closed:
        return (
            f"no gamepad found, and {', '.join(closed)} in {INPUTS} may not be read: join the group `input` with "
            "`sudo usermod -aG input $USER` and log in again"
        )
    return f"no gamepad found; input devices here: {', '.join(names) or 'none'}. Plug one in"
