"""Reports as they come from the device's USB endpoint."""

import struct
from collections.abc import Iterator

import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.experts.keys import Word
from lfd.experts.spacemouse import STALE_S, SpaceMouse, is_spacemouse, open_spacemouse

SPACE_NAVIGATOR = [
    "01 00 00 00 00 00 00",
    "02 00 00 e2 ff 00 00",  # turned about the second axis by -30
    "03 01 00",
    "03 00 00",
    "03 02 00",
    "03 00 00",
    "03 03 00",
]
"""Published captures of a SpaceNavigator's traffic: a turn, the left button, the right one, both."""


def stream(reports: list[str]) -> SpaceMouse:
    waiting: Iterator[bytes] = (bytes.fromhex(report) for report in reports)
    return SpaceMouse(lambda: next(waiting, b""))


def test_a_captured_space_navigator() -> None:
    state = stream(SPACE_NAVIGATOR).read()
    np.testing.assert_array_equal(state.translation, [0, 0, 0])
    np.testing.assert_allclose(state.rotation, [30 / 350, 0, 0])
    left, right = (Word.GRIPPER,), (Word.START, Word.SUCCESS)
    assert state.words == left + right + left + right


@pytest.mark.parametrize(
    ("pushed", "ours"),
    [
        ((350, 0, 0), (0, -1, 0)),  # to the right
        ((0, -350, 0), (1, 0, 0)),  # away from the person
        ((0, 0, -350), (0, 0, 1)),  # up
        ((0, 175, 0), (-0.5, 0, 0)),
        ((0, 400, 0), (-1, 0, 0)),  # some go beyond
    ],
)
def test_both_forms_of_report_give_the_same_axes(pushed, ours) -> None:
    zero = (0, 0, 0)
    old = stream([struct.pack("<B3h", 1, *pushed).hex(), struct.pack("<B3h", 2, *pushed).hex()]).read()
    new = stream([struct.pack("<B6h", 1, *pushed, *pushed).hex()]).read()
    moved = stream([struct.pack("<B6h", 1, *pushed, *zero).hex()]).read()
    for state in (old, new):
        np.testing.assert_allclose(state.translation, ours)
        np.testing.assert_allclose(state.rotation, ours)
    np.testing.assert_array_equal(moved.rotation, zero)


def test_the_axes_stay_right_handed() -> None:
    sent = np.eye(3, dtype=int) * 350
    mapped = np.array([stream([struct.pack("<B3h", 1, *axis).hex()]).read().translation for axis in sent])
    assert np.linalg.det(mapped) == pytest.approx(1.0)


def test_a_deflection_stays_until_the_next_report_and_ends_when_the_device_falls_silent() -> None:
    now, waiting = [0.0], [struct.pack("<B3h", 1, 0, -350, 0)]
    mouse = SpaceMouse(lambda: waiting.pop() if waiting else b"", clock=lambda: now[0])
    for now[0], away in ((0.0, 1), (STALE_S * 0.9, 1), (STALE_S * 1.1, 0)):
        np.testing.assert_array_equal(mouse.read().translation, [away, 0, 0])


def test_other_reports_and_the_buttons_of_larger_models_pass() -> None:
    mouse = stream(["17 64 00", "03 00 10 00 00 00 00", "01"])
    state = mouse.read()
    assert state.words == ()
    assert not state.translation.any()


def test_mice_and_keyboards_of_the_same_maker_are_no_space_mouse() -> None:
    def row(vendor: int, product: int, page: int, usage: int) -> dict:
        return {"vendor_id": vendor, "product_id": product, "usage_page": page, "usage": usage}

    assert is_spacemouse(row(0x256F, 0xC652, 1, 8))
    assert not is_spacemouse(row(0x256F, 0xC652, 1, 6))
    assert is_spacemouse(row(0x046D, 0xC626, 1, 8))
    assert not is_spacemouse(row(0x046D, 0xC52B, 1, 2))
    assert is_spacemouse(row(0x256F, 0xC635, 0, 0))
    assert not is_spacemouse(row(0x256F, 0xC654, 0, 0))


def test_without_a_device_the_present_ones_are_named() -> None:
    import hid

    if any(map(is_spacemouse, hid.enumerate())):
        pytest.skip("a SpaceMouse is plugged in")
    with pytest.raises(InputError, match="no SpaceMouse found; HID devices here: .*Plug one in"), open_spacemouse():
        pass
