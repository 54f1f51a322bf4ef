"""The page as a device: keys, a gamepad, a gizmo that is dragged, buttons.

While the driver's page is not heard, `read` does not return: the world is asked for nothing, so that the arm stands,
and goes on when the page is back. Nothing of the episode is lost.
"""

import threading
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np
from jaxtyping import Float

from lfd.console.messages import Input, Pad
from lfd.console.seats import Seats
from lfd.core.errors import LfdError
from lfd.core.protocols import Observation, Transition, World
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.device import DeviceState, pushed
from lfd.experts.keys import DOWN, LEFT, MOVES, RIGHT, UP, WORDS, Word
from lfd.experts.teleoperation import base_from_device

KEYS = {"ArrowUp": UP, "ArrowDown": DOWN, "ArrowLeft": LEFT, "ArrowRight": RIGHT, "Enter": "\n"}
"""What browsers call keys that terminals send as several characters; all others have the same name."""
STICKS = ((1, "x", -1), (0, "y", -1), (3, "ry", -1), (2, "rz", -1))
"""Number of an axis in the standard layout, to our axis and the direction along it; as `lfd.experts.gamepad` has it."""
PUSHED = ((7, "z", 1), (6, "z", -1), (15, "rx", 1), (14, "rx", -1))
"""The same for buttons: triggers, and left and right of the cross."""
BUTTONS: Mapping[int, tuple[Word, ...]] = {
    0: (Word.GRIPPER,),
    1: (Word.FAILURE,),
    2: (Word.DISCARD,),
    3: (Word.DISCARD,),
    4: (Word.SLOWER,),
    5: (Word.FASTER,),
    8: (Word.REDO,),
    9: (Word.START, Word.SUCCESS),
    16: (Word.QUIT,),
}
"""Number of a button to its words."""
AIM_M, AIM_RAD = 0.06, 0.4
"""Distance and angle to a dragged gizmo from which on the hand moves as fast as it may."""
PULL_M = 0.2
"""Distance from what was grabbed of the arm to the pointer from which on it is pulled with all that is possible [m]."""
POLL_S = 0.01


class Stopped(LfdError):
    """The person has ended what was going on."""


class BrowserDevice:
    """What the driver's page says, as any device's state."""

    name = "console"

    def __init__(self, seats: Seats, taken: Callable[[int], None] = lambda _: None):
        """`taken` is told the number of each message that a reading has taken in."""
        self._seats, self._taken, self._lock = seats, taken, threading.Lock()
        self._words: list[Word] = []
        self._down: frozenset[int] = frozenset()
        self._aim: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]] | None = None
        self._pull: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None
        self._stopped = threading.Event()
        self.frame = "base"
        self.hand = Hand()

    frame: str
    """In which directions the robot config has a device move (`lfd.worlds.robots.TeleopConfig`)."""
    hand: "Hand"
    """Where the gripper is; an observer of what goes on."""

    def say(self, word: Word) -> None:
        """A button of the page was pressed."""
        with self._lock:
            self._words.append(word)

    def aim(self, position: Float[np.ndarray, "3"] | None, wxyz: Float[np.ndarray, "4"] | None = None) -> None:
        """Move the hand to a pose in the world frame [m], until there is another one or none."""
        with self._lock:
            still = np.array([1.0, 0.0, 0.0, 0.0]) if wxyz is None else wxyz
            self._aim = None if position is None else (position, still)

    def pull(self, grabbed: Float[np.ndarray, "3"], to: Float[np.ndarray, "3"]) -> None:
        """Pull what was grabbed of the arm, now at a point of the world frame, towards another one [m], until let go.

        Like a spring: less as the arm comes nearer.
        """
        with self._lock:
            offset = grabbed - self.hand.position if self._pull is None else self._pull[0]
            self._pull = offset, to

    def let_go(self) -> None:
        """Nothing is pulled any more."""
        with self._lock:
            self._pull = None

    def begin(self) -> None:
        """Something new begins: nothing is held, dragged or said."""
        self._stopped.clear()
        self._seats.forget()
        with self._lock:
            self._words, self._down, self._aim, self._pull = [], frozenset(), None, None

    def stop(self) -> None:
        """End what is going on, at its next reading."""
        self._stopped.set()

    def check(self) -> None:
        """Raise `Stopped` when what is going on is to end."""
        if self._stopped.is_set():
            raise Stopped("stopped in the page")

    def read(self) -> DeviceState:
        """The present state; waits while no driver is there. Raises `Stopped`."""
        while True:
            self.check()
            heard = self._seats.read()
            if heard is not None:
                break
            with self._lock:  # what is dragged is let go
                self._aim, self._pull = None, None
            time.sleep(POLL_S)
        given, said = heard
        with self._lock:
            words, self._words = self._words, []
            fresh = _down(given.pad) - self._down
            self._down = _down(given.pad)
            dragged = self._dragged()
        words += [WORDS[key] for key in map(_key, said) if key in WORDS]
        words += [word for button in sorted(fresh) for word in BUTTONS.get(button, ())]
        self._taken(given.number)
        return pushed([*_pushes(given), *dragged], words)

    def _dragged(self) -> Iterator[tuple[str, float]]:
        """What the gizmo or a pull says, in the directions of the device."""
        turn = base_from_device(self.frame, self.hand.wxyz)
        way, rotation = np.zeros(3), np.zeros(3)
        if self._pull is not None:
            offset, to = self._pull
            way = (to - self.hand.position - offset) / PULL_M
        if self._aim is not None:
            position, wxyz = self._aim
            way = way + (position - self.hand.position) / AIM_M
            rotation = rotation_vector(matrix_from_wxyz(wxyz) @ matrix_from_wxyz(self.hand.wxyz).T) / AIM_RAD
        for axes, vector in (("x", "y", "z"), way), (("rx", "ry", "rz"), rotation):
            length = float(np.linalg.norm(vector))
            yield from zip(axes, (turn.T @ vector / max(1.0, length)).tolist(), strict=True)


class Hand:
    """An observer that knows where the gripper is: position [m] and orientation in the world frame."""

    def __init__(self) -> None:
        self.position, self.wxyz = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])

    def see(self, observation: Observation) -> None:
        """Take the gripper's pose from an observation, where it has one."""
        if "ee_pos" in observation and "ee_quat" in observation:
            self.position, self.wxyz = observation["ee_pos"], observation["ee_quat"]

    def begin(self, world: World, observation: Observation) -> None:
        self.see(observation)

    def step(self, world: World, transition: Transition) -> None:
        self.see(transition.result.observation)

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""


def rotation_vector(turn: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Axis times angle [rad] of a rotation matrix, the angle in [0, pi)."""
    across = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine, cosine = float(np.linalg.norm(across)), 0.5 * (float(np.trace(turn)) - 1.0)
    return across * (np.arctan2(sine, cosine) / sine) if sine > 1e-9 else np.zeros(3)


def _key(name: str) -> str:
    return KEYS.get(name, name.lower())


def _pushes(given: Input) -> Iterator[tuple[str, float]]:
    for key in dict.fromkeys(map(_key, given.keys)):
        if key in MOVES:
            axis, sign = MOVES[key]
            yield axis, float(sign)
    if given.pad is not None:
        for number, axis, sign in STICKS:
            if number < len(given.pad.axes):
                yield axis, sign * given.pad.axes[number]
        for number, axis, sign in PUSHED:
            if number < len(given.pad.buttons):
                yield axis, sign * given.pad.buttons[number]


def _down(pad: Pad | None) -> frozenset[int]:
    """The buttons that are pressed."""
    return frozenset() if pad is None else frozenset(i for i, value in enumerate(pad.buttons) if value > 0.5)
