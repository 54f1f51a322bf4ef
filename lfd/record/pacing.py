"""Real time: a policy that acts at the ticks of a clock, and says how late it was.

Ticks follow an absolute schedule, t_n = t_0 + n / hz, so that errors do not add up; a step that took too long is made
up for by the next ones. After a stall longer than `STALL_S` a new schedule begins, since a robot that races through
the ticks it missed would frighten its person.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from lfd.core.protocols import Decision, Observation, Policy

STALL_S = 0.5
"""Lateness after which the schedule begins anew [s]."""


@dataclass(frozen=True)
class Pace:
    """How well real time was kept."""

    steps: int
    mean_lateness_s: float
    """Mean time from a tick to the beginning of its step [s]."""
    p95_lateness_s: float
    """95th percentile of that time [s]."""
    max_lateness_s: float
    """Longest such time [s]."""
    overruns: int
    """Steps whose tick had passed before the step before was done."""
    stalls: int
    """How often the schedule began anew within an episode."""


class Paced:
    """A policy that is asked at the ticks of `control_hz` [Hz]: a device is then read when its step begins.

    The first step of an episode begins the schedule. Each decision carries its lateness as the channel `pace`.
    """

    def __init__(self, policy: Policy, control_hz: int):
        self.name = policy.name
        self._policy, self._period = policy, 1.0 / control_hz
        self._lateness: list[float] = []
        self._tick: float | None = None
        self._overruns = self._stalls = 0

    def reset(self, rng: np.random.Generator) -> None:
        self._policy.reset(rng)
        self._tick = None

    def act(self, observation: Observation) -> Decision:
        late = self._wait()
        self._lateness.append(late)
        decision = self._policy.act(observation)
        return replace(decision, signals={**decision.signals, "pace": {"lateness": late}})

    def summary(self) -> Pace:
        """Of all episodes so far."""
        late = np.array(self._lateness or [0.0])
        return Pace(
            steps=len(self._lateness),
            mean_lateness_s=round(float(late.mean()), 6),
            p95_lateness_s=round(float(np.percentile(late, 95)), 6),
            max_lateness_s=round(float(late.max()), 6),
            overruns=self._overruns,
            stalls=self._stalls,
        )

    def _wait(self) -> float:
        """Wait for the next tick; how late it is then [s]."""
        now = time.perf_counter()
        tick = now if self._tick is None else self._tick
        if now > tick:
            self._overruns += 1
        else:
            time.sleep(tick - now)
        late = time.perf_counter() - tick
        self._stalls += late > STALL_S
        self._tick = self._period + (tick if late <= STALL_S else tick + late)
        return late
