import time

import numpy as np
import pytest

from lfd.core.protocols import Decision, Observation
from lfd.record.pacing import STALL_S, Paced
from lfd.worlds.rollout import rollout


class Still:
    """Does nothing, and takes as long for it as it is told; remembers when it was asked."""

    name = "still"

    def __init__(self, size: int, *delays: float):
        self._size, self._delays = size, iter(delays)
        self.asked: list[float] = []

    def reset(self, rng: np.random.Generator) -> None: ...

    def act(self, observation: Observation) -> Decision:
        self.asked.append(time.perf_counter())
        time.sleep(next(self._delays, 0.0))
        return Decision(np.zeros(self._size), signals={"teleop_axes": {"x": 1.0}})


def asked_at(hz: int, steps: int, *delays: float) -> tuple[np.ndarray, Paced, list[Decision]]:
    still = Still(1, *delays)
    paced = Paced(still, hz)
    paced.reset(np.random.default_rng(0))
    decisions = [paced.act({}) for _ in range(steps)]
    return np.array(still.asked) - still.asked[0], paced, decisions


def test_steps_begin_at_the_ticks_and_errors_do_not_add_up() -> None:
    times, paced, decisions = asked_at(100, 50, *[0.002] * 50)
    assert (times >= np.arange(50) / 100 - 0.002).all()  # never early, but for the first one's own lateness
    assert np.median(times - np.arange(50) / 100) < 0.01
    lateness = [decision.signals["pace"]["lateness"] for decision in decisions]
    pace = paced.summary()
    assert pace.steps == 50
    assert pace.mean_lateness_s == pytest.approx(np.mean(lateness), abs=1e-6)
    assert pace.max_lateness_s == pytest.approx(np.max(lateness), abs=1e-6)
    assert min(lateness) >= 0


def test_signals_of_the_policy_stay() -> None:
    _, _, (decision,) = asked_at(100, 1)
    assert set(decision.signals) == {"teleop_axes", "pace"}


def test_a_slow_step_is_made_up_for() -> None:
    times, paced, decisions = asked_at(50, 8, 0, 0.05)
    assert paced.summary().overruns >= 1
    assert paced.summary().stalls == 0
    assert decisions[2].signals["pace"]["lateness"] >= 0.009
    assert times[-1] == pytest.approx(7 / 50, abs=0.02)  # back on the first schedule


def test_after_a_stall_a_new_schedule_begins() -> None:
    times, paced, _ = asked_at(50, 5, 0, STALL_S + 0.1)
    assert paced.summary().stalls == 1
    assert np.diff(times)[2:] == pytest.approx(0.02, abs=0.015)  # no racing


def test_the_real_loop_keeps_its_rate(lift_world, record_property) -> None:
    """What this machine does at 20 Hz is recorded; a busy machine is no mistake of ours."""
    still = Still(7)
    paced = Paced(still, 20)
    rollout(lift_world, paced, [], np.random.default_rng(2), horizon=40, hold_steps=40)
    pace = paced.summary()
    for name in ("mean_lateness_s", "p95_lateness_s", "max_lateness_s", "overruns"):
        record_property(name, getattr(pace, name))
    print(pace)
    assert pace.steps == 40
    assert still.asked[-1] - still.asked[0] >= 39 / 20 - 0.05
