"""Who watches and who drives: one at a time, by a lock that everybody sees and that can be passed on.

A seat is a tab of a browser. The first one drives. Whoever drives may pass the arm on; it is then free to take. A
driver whose connection is lost keeps the arm for when they are back, unless another one takes it.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from secrets import token_hex

from lfd.console.messages import Input

STALE_S = 0.12
"""A page that was not heard for so long is not there [s]: the arm stands within 0.2 s, control step included."""
SAID = 64
"""Presses that wait for a control step at most."""
LATENCIES = 400
"""Latest latencies that are kept."""


@dataclass
class Seat:
    """A tab."""

    heard: float
    """When it was heard last [s]."""
    input: Input = field(default_factory=lambda: Input(0))
    said: deque[str] = field(default_factory=lambda: deque(maxlen=SAID))


class Seats:
    """All tabs; any thread may ask."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock, self._lock = clock, threading.Lock()
        self._seats: dict[str, Seat] = {}
        self._driver = ""
        self._changed: list[Callable[[], None]] = []
        self.latencies_ms: deque[float] = deque(maxlen=LATENCIES)
        self.heard_at = 0.0

    heard_at: float
    """When a driver was heard last, by the clock [s]."""
    latencies_ms: deque[float]
    """The latest latencies that pages measured, from an event to a control step and back."""

    def on_change(self, call: Callable[[], None]) -> None:
        """Have a function called whenever tabs come, go, or another one drives."""
        self._changed.append(call)

    @property
    def driver(self) -> str:
        """The tab that drives, whether it is there or not; empty for none."""
        return self._driver

    @property
    def count(self) -> int:
        """Tabs that are connected."""
        return len(self._seats)

    def sit(self, tab: str) -> str:
        """A tab has come, or is back; the name that it has. A name that another one uses just now is not given twice.

        The first one drives.
        """
        with self._lock:
            other = self._seats.get(tab)
            if other is not None and self._is_there(other):
                tab = token_hex(8)
            self._seats[tab] = Seat(self._clock())
            self._driver = self._driver or tab
        self._tell()
        return tab

    def leave(self, tab: str) -> None:
        """A tab's connection has ended."""
        with self._lock:
            self._seats.pop(tab, None)
        self._tell()

    def hear(self, tab: str, given: Input) -> None:
        """Take in what a tab says; what one says that does not drive has no effect."""
        with self._lock:
            seat = self._seats.get(tab)
            if seat is None:
                return
            seat.heard, seat.input = self._clock(), given
            if tab == self._driver:
                self.heard_at = seat.heard
                seat.said.extend(given.said)
                self.latencies_ms.extend(given.late_ms)

    def take(self, tab: str) -> bool:
        """Drive, if nobody does who is there; whether the tab drives now."""
        with self._lock:
            driver = self._seats.get(self._driver)
            if tab not in self._seats or (tab != self._driver and driver is not None and self._is_there(driver)):
                return False
            self._driver = tab
            self._seats[tab].said.clear()
        self._tell()
        return True

    def pass_on(self, tab: str) -> bool:
        """Let others drive; whether the tab drove."""
        with self._lock:
            if tab != self._driver:
                return False
            self._driver = ""
        self._tell()
        return True

    def read(self) -> tuple[Input, tuple[str, ...]] | None:
        """What the driver holds down, and what they pressed since the last reading; None while no driver is there."""
        with self._lock:
            seat = self._seats.get(self._driver)
            if seat is None or not self._is_there(seat):
                return None
            said = tuple(seat.said)
            seat.said.clear()
            return seat.input, said

    def forget(self) -> None:
        """What was pressed before something new began is not meant for it."""
        with self._lock:
            for seat in self._seats.values():
                seat.said.clear()

    def _is_there(self, seat: Seat) -> bool:
        return self._clock() - seat.heard <= STALE_S

    def _tell(self) -> None:
        for call in self._changed:
            call()
