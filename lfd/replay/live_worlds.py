"""What goes on in many worlds, live: some of their episodes as they move, and the success so far.

Worlds run much faster than a person can look. So each world's place in the view takes an episode, plays it in the
time of the simulated clock, and then takes the one that has just begun; those between are only counted. All that a
world's own thread does for it is to keep states: they are drawn from another thread, a few times a second.
"""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np

from lfd.core.protocols import Observation, Observer, Observers, Transition, World
from lfd.replay.clip import kept_model
from lfd.replay.live_view import INTEGRATION, Scene
from lfd.run.wilson import wilson_interval

PLACES = 4
"""Worlds that are shown at the most."""
DRAWN_HZ = 8.0
"""Pictures a second [Hz]."""
LINGER_S = 0.7
"""For how long the end of an episode stays [s]."""
RATE = ("success", "interval_low", "interval_high")
"""Curves of the success rate so far, with its 95% Wilson interval."""


@runtime_checkable
class Board(Protocol):
    """Draws worlds and curves somewhere."""

    def scene(self, place: int) -> Scene: ...

    def tell(self, values: dict[str, float]) -> None: ...

    def close(self) -> None: ...


@dataclass
class _Reel:
    """The states of an episode that is shown, from the first; its world adds to them while it runs."""

    model_xml: str
    hz: int
    states: list[np.ndarray]
    began: float = field(default_factory=time.monotonic)
    """On this machine's clock [s]."""
    over: bool = False

    def frame(self, now: float) -> int:
        """Which state is to be seen now."""
        return min(int((now - self.began) * self.hz), len(self.states) - 1)

    def has_ended(self, now: float) -> bool:
        return self.over and (now - self.began) > len(self.states) / self.hz + LINGER_S


class LiveWorlds:
    """Shows worlds on a board; `begin` gives what the episodes of a run need for it.

    The shapes are those of the first episode: where a size is drawn for each one, such as that of Lift's cube, it is
    shown as it was then.
    """

    def __init__(self, board: Board):
        self._board, self._lock = board, threading.Lock()
        self._reels: dict[int, _Reel | None] = {}
        """Place to what it shows."""
        self._place_of: dict[int, int] = {}
        """The id of a world of the run to its place."""
        self._ended: list[bool] = []
        """Successes of the run."""
        self._over = threading.Event()
        self._drawing = threading.Thread(target=self._draw_all, name="live view", daemon=True)
        self._error: BaseException | None = None
        self._drawing.start()

    def begin(self) -> Observers:
        """What watches the episodes of a run that begins: its worlds take the places, its success is counted."""
        self._ended, self._place_of = [], {}
        return self._watching

    def _watching(self, index: int) -> Sequence[Observer]:
        """What watches the episode with a number."""
        del index
        return [_Watcher(self)]

    def close(self) -> None:
        """Draw the rest, and end. Raises what went wrong while drawing."""
        self._over.set()
        self._drawing.join()
        self._board.close()
        if self._error is not None:
            raise self._error

    def reel_for(self, world: World) -> _Reel | None:
        """Where an episode that begins puts its states; None while its place shows another one."""
        with self._lock:
            place = self._place_of.setdefault(id(world), len(self._place_of))
            if place >= PLACES or self._reels.get(place) is not None:
                return None
            reel = _Reel(world.get_state().model_xml, world.spec.control_hz, [world.sim_state()])
            self._reels[place] = reel
        return reel

    def count(self, success: bool) -> None:
        """Take note of an episode's end."""
        self._ended.append(success)

    def _draw_all(self) -> None:
        try:
            stage = _Stage(self._board)
            told = self._ended, 0
            while not self._over.wait(1.0 / DRAWN_HZ):
                now = time.monotonic()
                with self._lock:
                    shown = {place: reel for place, reel in self._reels.items() if reel is not None}
                    self._reels |= {place: None for place, reel in shown.items() if reel.has_ended(now)}
                for place, reel in shown.items():
                    stage.draw(place, reel.model_xml, reel.states[reel.frame(now)])
                told = self._tell(told)
            self._tell(told)
        except BaseException as error:  # it would be lost with the thread; the run itself goes on
            self._error = error

    def _tell(self, told: tuple[list[bool], int]) -> tuple[list[bool], int]:
        """Let the curves go on if an episode has ended since `told`, the run's and how many; those of now."""
        of = self._ended  # another run may begin meanwhile
        ended = len(of)
        if ended > (told[1] if of is told[0] else 0):
            won = sum(of[:ended])
            self._board.tell(dict(zip(RATE, (won / ended, *wilson_interval(won, ended)), strict=True)))
        return of, ended


class _Stage:
    """The worlds' model, once, and a scene for each place."""

    def __init__(self, board: Board):
        self._board, self._model = board, None
        self._scenes: dict[int, Scene] = {}
        self._last: dict[int, np.ndarray] = {}

    def draw(self, place: int, model_xml: str, state: np.ndarray) -> None:
        """Show a state, unless it is the one that is seen already."""
        if self._model is None:
            self._model = kept_model(model_xml)
            self._data = mujoco.MjData(self._model)
        if place not in self._scenes:
            self._scenes[place] = self._board.scene(place)
            self._scenes[place].load(self._model)
        if self._last.get(place) is state:
            return
        self._last[place] = state
        mujoco.mj_setState(self._model, self._data, state, INTEGRATION)
        mujoco.mj_kinematics(self._model, self._data)
        self._scenes[place].move(self._data)


class _Watcher:
    """Keeps the states of an episode that is shown, and how it ended."""

    def __init__(self, live: LiveWorlds):
        self._live = live
        self._reel: _Reel | None = None

    def begin(self, world: World, observation: Observation) -> None:
        self._reel = self._live.reel_for(world)

    def step(self, world: World, transition: Transition) -> None:
        if self._reel is not None:
            self._reel.states.append(world.sim_state())

    def end(self, success: bool) -> None:
        self._live.count(success)
        self.abort()

    def abort(self) -> None:
        if self._reel is not None:
            self._reel.over = True


@contextmanager
def live_worlds(title: str, worlds: int, tell: Callable[[str], None]) -> Iterator[LiveWorlds]:
    """Worlds, at most `worlds` of them, in Rerun's page while the block runs; `tell` gets its address.

    Raises `LfdError` when Rerun's viewer does not start.
    """
    from lfd.replay.rerun_live import RerunBoard, serving

    with serving() as (address, source):
        tell(address)
        live = LiveWorlds(RerunBoard(source, title, [RATE], scenes=min(worlds, PLACES)))
        try:
            yield live
        finally:
            live.close()


@contextmanager
def live_curves(tell: Callable[[str], None]) -> Iterator[Callable[[dict[str, float | int]], None]]:
    """A function that takes rows of a training's curve and lets them grow in Rerun's page while the block runs.

    Raises `LfdError` when Rerun's viewer does not start.
    """
    from lfd.replay.rerun_live import RerunBoard, serving

    with serving() as (address, source):
        tell(address)
        board = RerunBoard(source, "training", [("loss",), ("score",), ("learning_rate",)], clock="gradient_step")
        try:
            yield lambda row: board.tell(
                {name: float(value) for name, value in row.items() if name != "step"}, int(row["step"])
            )
        finally:
            board.close()
