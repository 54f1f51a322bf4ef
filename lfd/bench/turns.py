"""Sides that are measured in turns, so that what slows the machine for a while slows all of them."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Side = Callable[[int], float]
"""Does something so many times and returns the seconds that it took."""


@dataclass(frozen=True)
class Turns:
    """Rates [1/s] of every side, one a turn."""

    rates: Mapping[str, Sequence[float]]

    def rate(self, side: str) -> float:
        """The rate in the median turn."""
        return float(np.median(self.rates[side]))

    def ratio(self, side: str, other: str) -> float:
        """How many times as fast one side is as another: the median of the turns' ratios."""
        return float(np.median(np.divide(self.rates[side], self.rates[other])))


def take_turns(sides: Mapping[str, Side], *, turns: int, seconds: float) -> Turns:
    """Let all sides work in turn, each for about `seconds` at a time."""
    times = {name: _times(run, seconds) for name, run in sides.items()}
    rates: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(turns):
        for name, run in sides.items():
            rates[name].append(times[name] / run(times[name]))
    return Turns(rates)


def _times(run: Side, seconds: float) -> int:
    """How often fits into `seconds`; what a side does only once, such as reserving memory, is over then."""
    times = 1
    while (took := run(times)) < seconds / 4:
        times *= 2
    return max(1, round(times * seconds / took))


def by_wall_clock(call: Callable[[], Any]) -> Side:
    """A side whose seconds are those of the clock on the wall."""
    return _timed(call, time.perf_counter)


def by_cpu_time(call: Callable[[], Any]) -> Side:
    """A side whose seconds are those of this process' CPU time."""
    return _timed(call, time.process_time)


def _timed(call: Callable[[], Any], clock: Callable[[], float]) -> Side:
    def run(times: int) -> float:
        began = clock()
        for _ in range(times):
            call()
        return clock() - began

    return run
