"""The SpaceMouse family of 3Dconnexion as a device. The only module that imports hidapi (hid, hidraw).

The cap sends signed 16-bit numbers in [-350, 350], little-endian, after a byte that numbers the report:

    SpaceNavigator, Compact, Pro      01 xx xx yy yy zz zz          translation
                                      02 xx xx yy yy zz zz          rotation
    Wireless, Enterprise, receivers   01 followed by all six
    every model                       03 and the buttons as bits

Its axes are x to the right, y towards the person, z down; rotations are right-handed about these. Ours are x away,
y to the left, z up, hence (x, y, z) = -(y, x, z) of the device for both.
"""

import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from lfd.core.errors import InputError, LfdError
from lfd.experts.device import DeviceState
from lfd.experts.keys import Word

if sys.platform == "linux":
    import hidraw as hid  # hid goes through libusb there: no Bluetooth, and it takes the device away from the kernel
else:
    import hid

FULL = 350.0
"""Number that the cap sends at full deflection."""
STALE_S = 0.25
"""Silence after which a deflected cap counts as released [s]; while deflected it reports every 8 or 16 ms."""
TRANSLATION, ROTATION, BUTTONS = 1, 2, 3
OURS = [1, 0, 2]
"""Which of the device's axes ours are, all with their sign turned."""
LOGITECH, CONNEXION = 0x046D, 0x256F
LOGITECH_MODELS = (0xC605, 0xC621, 0xC623, 0xC625, 0xC626, 0xC627, 0xC628, 0xC629, 0xC62B)
"""Models from when 3Dconnexion was Logitech's, without the Plus XT and the Classic, whose axes differ."""
CONNEXION_MODELS = (0xC62E, 0xC62F, 0xC631, 0xC632, 0xC633, 0xC635, 0xC636, 0xC638, 0xC63A, 0xC641, 0xC652)
MULTI_AXIS = (0x01, 0x08)
"""HID usage page and usage of a multi-axis controller; 3Dconnexion's mice and keyboards have others."""
SAID: dict[int, tuple[Word, ...]] = {0: (Word.GRIPPER,), 1: (Word.START, Word.SUCCESS)}
"""Button to its words; at any time only one of start and success has a meaning."""

PERMISSION = (
    'On Linux your user must be allowed to read it: put `KERNEL=="hidraw*", ATTRS{idVendor}=="256f", TAG+="uaccess"` '
    "(046d for older models) into /etc/udev/rules.d/70-spacemouse.rules and plug it in again"
)


class SpaceMouse:
    """Turns reports into states. `next_report` gives the next report that waits, empty when there is none."""

    name = "spacemouse"

    def __init__(self, next_report: Callable[[], bytes], clock: Callable[[], float] = time.monotonic):
        self._next_report, self._clock = next_report, clock
        self._axes, self._buttons, self._heard = np.zeros(6), 0, clock()

    def read(self) -> DeviceState:
        words: list[Word] = []
        while report := self._next_report():
            words += self._take(report)
        if self._clock() - self._heard > STALE_S:  # a lost radio link must not leave the robot moving
            self._axes[:] = 0.0
        translation, rotation = -self._axes[:3][OURS], -self._axes[3:][OURS]
        return DeviceState(translation=translation, rotation=rotation, words=tuple(words))

    def _take(self, report: bytes) -> list[Word]:
        """Keep what a report says of the axes; the words of buttons that went down. Other reports (battery) pass."""
        number, content = report[0], report[1:]
        if number in (TRANSLATION, ROTATION) and len(content) >= 6:
            count = 6 if number == TRANSLATION and len(content) >= 12 else 3
            begin = 3 if number == ROTATION else 0
            values = np.array(struct.unpack_from(f"<{count}h", content), dtype=float)
            self._axes[begin : begin + count] = np.clip(values / FULL, -1.0, 1.0)
            self._heard = self._clock()
        if number != BUTTONS:
            return []
        down = int.from_bytes(content, "little")
        fresh, self._buttons = down & ~self._buttons, down
        return [word for button, words in SAID.items() if fresh >> button & 1 for word in words]


@contextmanager
def open_spacemouse() -> Iterator[SpaceMouse]:
    """The first SpaceMouse that is plugged in.

    Raises `InputError` when there is none, or when it may not be read.
    """
    present = hid.enumerate()
    found = [about for about in present if is_spacemouse(about)]
    if not found:
        names = {f"{a['product_string'] or '?'} ({a['vendor_id']:04x}:{a['product_id']:04x})" for a in present}
        raise InputError(f"no SpaceMouse found; HID devices here: {', '.join(sorted(names)) or 'none'}. Plug one in")
    handle = hid.device()
    try:
        handle.open_path(found[0]["path"])
    except OSError as error:
        name = found[0]["product_string"]
        raise InputError(f"{name} cannot be opened ({error}): close programs that use it. {PERMISSION}") from error
    handle.set_nonblocking(True)

    def next_report() -> bytes:
        try:
            return bytes(handle.read(64))
        except OSError as error:
            raise LfdError(f"the SpaceMouse is gone ({error}); plug it in and go on with --resume") from error

    try:
        yield SpaceMouse(next_report)
    finally:
        handle.close()


def is_spacemouse(about: dict[str, Any]) -> bool:
    """Whether a row of `hid.enumerate()` is the part of a SpaceMouse that sends its motion."""
    vendor, product = about["vendor_id"], about["product_id"]
    usage = about["usage_page"], about["usage"]
    if usage != (0, 0):  # not every platform tells
        return usage == MULTI_AXIS and (vendor == CONNEXION or (vendor == LOGITECH and product in LOGITECH_MODELS))
    return product in {CONNEXION: CONNEXION_MODELS, LOGITECH: LOGITECH_MODELS}.get(vendor, ())
