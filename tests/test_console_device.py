"""The page as a device, and who drives."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from lfd.console.browser_device import AIM_M, PULL_M, BrowserDevice, Stopped, rotation_vector
from lfd.console.folder import Folder
from lfd.console.messages import Input, Pad
from lfd.console.seats import STALE_S, Seats
from lfd.core.errors import InputError
from lfd.experts.keys import Word


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def seated(*tabs: str) -> tuple[Seats, Clock]:
    seats = Seats(clock := Clock())
    for tab in tabs:
        seats.sit(tab)
    return seats, clock


def test_the_first_tab_drives_and_passes_the_arm_on() -> None:
    seats, clock = seated("one", "two")
    assert seats.driver == "one"
    assert not seats.take("two")
    assert not seats.pass_on("two")
    assert seats.pass_on("one")
    assert seats.driver == ""
    assert seats.take("two")
    assert seats.driver == "two"
    clock.now = 1.0
    seats.hear("two", Input(1))
    assert not seats.take("one")


def test_a_driver_who_is_lost_keeps_the_arm_until_another_one_takes_it() -> None:
    seats, clock = seated("one", "two")
    clock.now = 2 * STALE_S
    assert seats.read() is None
    assert seats.driver == "one"
    seats.leave("one")
    assert seats.sit("one") == "one"
    assert seats.driver == "one"
    assert seats.read() is not None
    seats.leave("one")
    assert seats.take("two")
    seats.sit("one")
    assert seats.driver == "two"


def test_two_tabs_of_one_name_are_two() -> None:
    seats, clock = seated("same")
    other = seats.sit("same")
    assert other != "same"
    assert seats.driver == "same"
    clock.now = 2 * STALE_S
    assert seats.sit("same") == "same"  # the first one is lost: this is the page again


def test_what_one_says_who_watches_has_no_effect() -> None:
    seats, _ = seated("one", "two")
    seats.hear("two", Input(5, ("w",), ("y",)))
    assert seats.read() == (Input(0), ())
    seats.hear("one", Input(6, ("a",), ("n", "y")))
    assert seats.read() == (Input(6, ("a",), ("n", "y")), ("n", "y"))
    assert seats.read() == (Input(6, ("a",), ("n", "y")), ())  # said once


def device_of(*said: Input, frame: str = "base") -> tuple[BrowserDevice, list[int]]:
    seats, taken = Seats(), []
    seats.sit("one")
    for one in said:
        seats.hear("one", one)
    device = BrowserDevice(seats, taken.append)
    device.frame = frame
    return device, taken


def test_keys_gamepad_and_buttons_are_what_they_are_on_other_devices() -> None:
    device, taken = device_of(Input(3, ("w", "ArrowLeft", "R", "Shift"), ("Enter", "Y", "F5")))
    state = device.read()
    assert state.translation.tolist() == [1.0, 1.0, 1.0]
    assert state.words == (Word.START, Word.SUCCESS)
    assert taken == [3]
    pad = Pad((0.5, -1.0, 0.25, 0.0), (1.0, 0, 0, 0, 0, 0, 0.0, 0.5))
    device, _ = device_of(Input(1, pad=pad))
    device.say(Word.REDO)
    state = device.read()
    assert state.translation.tolist() == [1.0, -0.5, 0.5]
    assert state.rotation.tolist() == [0.0, 0.0, -0.25]
    assert state.words == (Word.REDO, Word.GRIPPER)
    assert device.read().words == ()  # held down, not pressed again


def test_what_was_pressed_before_is_not_meant_for_what_begins() -> None:
    device, _ = device_of(Input(1, (), ("n",)))
    device.say(Word.GRIPPER)
    device.begin()
    assert device.read().words == ()


@pytest.mark.parametrize(("frame", "away"), [("base", 1.0), ("view", -1.0)])
def test_a_dragged_gizmo_deflects_along_the_way_to_it(frame: str, away: float) -> None:
    device, _ = device_of(Input(1), frame=frame)
    device.hand.position = np.array([0.1, 0.0, 1.0])
    device.aim(np.array([0.1 + 0.5 * AIM_M, 0.0, 1.0]))
    assert device.read().translation == pytest.approx([0.5 * away, 0.0, 0.0])
    device.aim(np.array([0.1, 10.0, 1.0]))
    assert device.read().translation == pytest.approx([0.0, away, 0.0])  # as fast as it may
    half = np.sqrt(0.5)
    device.aim(device.hand.position, np.array([half, 0.0, 0.0, half]))
    assert device.read().rotation == pytest.approx([0.0, 0.0, 1.0])
    device.aim(None)
    assert not device.read().translation.any()


def test_what_is_pulled_comes_nearer_to_the_pointer() -> None:
    device, _ = device_of(Input(1), frame="view")
    grabbed = np.array([0.0, 0.0, 0.1])
    to = grabbed + PULL_M * np.array([0.0, 0.3, 0.4])
    device.pull(grabbed, to)
    assert device.read().translation == pytest.approx([0.0, -0.3, 0.4])
    device.hand.position = PULL_M * np.array([0.0, 0.3, 0.2])  # the arm has moved, and the pointer has not
    assert device.read().translation == pytest.approx([0.0, 0.0, 0.2])
    device.let_go()
    assert not device.read().translation.any()


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0, 3.0])
def test_the_rotation_vector_is_axis_times_angle(angle: float) -> None:
    axis = np.array([1.0, -2.0, 2.0]) / 3.0
    cross = np.cross(np.eye(3), axis)
    turn = np.eye(3) + np.sin(angle) * cross.T + (1 - np.cos(angle)) * cross.T @ cross.T  # Rodrigues
    if not np.allclose(turn @ axis, axis):
        turn = turn.T
    found = rotation_vector(turn)
    assert abs(np.linalg.norm(found) - angle) < 1e-9
    assert abs(abs(found @ axis) - angle) < 1e-9


def test_the_arm_stands_while_the_driver_is_not_heard_and_goes_on_afterwards() -> None:
    device, _ = device_of(Input(1, ("w",)))
    assert device.read().translation[0] == 1.0
    device.aim(np.ones(3))
    time.sleep(1.5 * STALE_S)
    read = []
    thread = threading.Thread(target=lambda: read.append(device.read()))
    thread.start()
    thread.join(0.3)
    assert thread.is_alive()
    assert not read
    device._seats.hear("one", Input(2))
    thread.join(5.0)
    assert read[0].translation.tolist() == [0.0, 0.0, 0.0]  # what was dragged is let go


def test_stop_ends_a_reading_that_waits() -> None:
    device = BrowserDevice(Seats())
    threading.Timer(0.1, device.stop).start()
    with pytest.raises(Stopped):
        device.read()
    device.begin()
    device.check()


@pytest.mark.parametrize("name", ["", " ", ".", "..", "../x", "a/../../x", "/etc", "/", "a\0b"])
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="such as mine"):
        Folder(tmp_path / "in").place(name)


def test_links_that_lead_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="leads out"):
        Folder(tmp_path / "in").place("link/x")
    assert Folder(tmp_path / "in").place("a/b") == tmp_path / "in" / "a" / "b"
