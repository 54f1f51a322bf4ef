"""Input events as the kernel writes them: from a virtual device where this machine allows one, else from a pipe."""

import os
import struct
import sys
import time

import numpy as np
import pytest

if sys.platform != "linux":
    pytest.skip("gamepads are read through Linux' input events", allow_module_level=True)

from evdev import AbsInfo, InputDevice, UInput, ecodes
from evdev.eventio import EventIO

from lfd.core.errors import InputError, LfdError
from lfd.experts.gamepad import Gamepad, is_gamepad, open_gamepad
from lfd.experts.keys import Word

RANGES = {
    **dict.fromkeys((ecodes.ABS_X, ecodes.ABS_Y, ecodes.ABS_RX, ecodes.ABS_RY), (-32768, 32767)),
    **dict.fromkeys((ecodes.ABS_Z, ecodes.ABS_RZ), (0, 1023)),
    **dict.fromkeys((ecodes.ABS_HAT0X, ecodes.ABS_HAT0Y), (-1, 1)),
}
"""Those of an Xbox pad with the kernel's driver xpad."""
WRITABLE = os.access("/dev/uinput", os.W_OK)
KEYS = [
    *(ecodes.BTN_SOUTH, ecodes.BTN_EAST, ecodes.BTN_NORTH, ecodes.BTN_WEST, ecodes.BTN_TL, ecodes.BTN_TR),
    *(ecodes.BTN_SELECT, ecodes.BTN_START, ecodes.BTN_MODE),
]


def about(code: int, value: int = 0) -> AbsInfo:
    """What the kernel tells of an axis."""
    low, high = RANGES[code]
    return AbsInfo(value=value, min=low, max=high, fuzz=0, flat=0, resolution=0)


class Pipe(EventIO):
    """The reading end of a pipe, read by the code that reads a device."""

    def __init__(self) -> None:
        self.fd, self._writing = os.pipe()
        os.set_blocking(self.fd, False)
        self.values = dict.fromkeys(RANGES, 0)

    def send(self, *events: tuple[int, int, int]) -> None:
        """Write struct input_event of linux/input.h: time as two longs, type, code, value."""
        for kind, code, value in (*events, (ecodes.EV_SYN, ecodes.SYN_REPORT, 0)):
            if kind == ecodes.EV_ABS:
                self.values[code] = value
            os.write(self._writing, struct.pack("@llHHi", 1, 0, kind, code, value))

    def axes(self) -> dict[int, AbsInfo]:
        return {code: about(code, value) for code, value in self.values.items()}

    def close(self) -> None:
        os.close(self._writing)


@pytest.fixture
def pad():
    """A gamepad, and what sends events as its hardware would."""
    if not WRITABLE:
        pipe = Pipe()
        yield Gamepad(pipe, pipe.axes), pipe.send
        pipe.close()
        os.close(pipe.fd)
        return
    able = {ecodes.EV_KEY: KEYS, ecodes.EV_ABS: [(code, about(code)) for code in RANGES]}
    with UInput(able, name="lfd test pad") as device:
        path = device.device.path if device.device else ""
        deadline = time.monotonic() + 5
        while not os.access(path, os.R_OK):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        opened = InputDevice(path)
        assert is_gamepad(opened)

        def send(*events: tuple[int, int, int]) -> None:
            for event in events:
                device.write(*event)
            device.syn()
            time.sleep(0.05)

        yield Gamepad(opened, lambda: {code: opened.absinfo(code) for code in RANGES}), send
        opened.close()


def axis(code: int, value: int) -> tuple[int, int, int]:
    return ecodes.EV_ABS, code, value


def key(code: int, value: int) -> tuple[int, int, int]:
    return ecodes.EV_KEY, code, value


def test_a_pad_at_rest_says_nothing(pad) -> None:
    gamepad, _ = pad
    state = gamepad.read()
    np.testing.assert_allclose(state.translation, 0, atol=1e-4)
    np.testing.assert_allclose(state.rotation, 0, atol=1e-4)
    assert state.words == ()


@pytest.mark.parametrize(
    ("events", "translation", "rotation"),
    [
        ([axis(ecodes.ABS_Y, -32768)], (1, 0, 0), (0, 0, 0)),  # away
        ([axis(ecodes.ABS_X, -32768)], (0, 1, 0), (0, 0, 0)),  # left
        ([axis(ecodes.ABS_RZ, 1023)], (0, 0, 1), (0, 0, 0)),  # up
        ([axis(ecodes.ABS_Z, 1023)], (0, 0, -1), (0, 0, 0)),
        ([axis(ecodes.ABS_HAT0X, 1)], (0, 0, 0), (1, 0, 0)),  # roll to the right
        ([axis(ecodes.ABS_RY, -32768)], (0, 0, 0), (0, 1, 0)),  # tip away
        ([axis(ecodes.ABS_RX, -32768)], (0, 0, 0), (0, 0, 1)),  # turn to the left
        ([axis(ecodes.ABS_Y, 16384), axis(ecodes.ABS_X, 32767)], (-0.5, -1, 0), (0, 0, 0)),
    ],
)
def test_sticks_triggers_and_cross(events, translation, rotation, pad) -> None:
    gamepad, send = pad
    send(*events)
    for _ in range(2):  # a stick that rests elsewhere sends no more events
        state = gamepad.read()
        np.testing.assert_allclose(state.translation, translation, atol=1e-4)
        np.testing.assert_allclose(state.rotation, rotation, atol=1e-4)


def test_buttons_say_their_words_when_they_go_down(pad) -> None:
    gamepad, send = pad
    for code in KEYS:
        send(key(code, 1))
        send(key(code, 0))
    words = [Word.GRIPPER, Word.FAILURE, Word.DISCARD, Word.DISCARD, Word.SLOWER, Word.FASTER]
    words += [Word.REDO, Word.START, Word.SUCCESS, Word.QUIT]
    assert list(gamepad.read().words) == words
    assert gamepad.read().words == ()


def test_what_the_kernel_dropped_is_looked_up() -> None:
    pipe = Pipe()
    gamepad = Gamepad(pipe, pipe.axes)
    pipe.send(axis(ecodes.ABS_Y, -32768))
    np.testing.assert_allclose(gamepad.read().translation, [1, 0, 0], atol=1e-4)
    pipe.values[ecodes.ABS_Y] = 0  # let go; the event is lost
    pipe.send((ecodes.EV_SYN, ecodes.SYN_DROPPED, 0), key(ecodes.BTN_SOUTH, 1))
    state = gamepad.read()
    np.testing.assert_allclose(state.translation, 0, atol=1e-4)
    assert state.words == ()
    pipe.close()
    os.close(pipe.fd)


def test_a_pad_that_is_pulled_out_is_an_error() -> None:
    pipe = Pipe()
    gamepad = Gamepad(pipe, pipe.axes)
    os.close(pipe.fd)
    with pytest.raises(LfdError, match="the gamepad is gone .*--resume"):
        gamepad.read()
    pipe.close()


def test_without_a_pad_the_present_devices_are_named() -> None:
    with pytest.raises(InputError, match="no gamepad found"), open_gamepad():
        pytest.skip("a gamepad is plugged in")
