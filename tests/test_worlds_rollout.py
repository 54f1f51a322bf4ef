from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lfd.core.protocols import Decision, StepResult, WorldState
from lfd.worlds.rollout import Outcome, rollout


class Line:
    """A point on a line; the action moves it, beyond 1 the task is solved."""

    spec: Any = None

    def sim_state(self):
        return np.array([self.x])

    def get_state(self):
        return WorldState(model_xml="", sim=self.sim_state(), memory={})

    def set_state(self, state):
        self.x = float(state.sim[0])
        return {"x": state.sim}

    def reset(self, rng):
        self.x = rng.uniform(0, 0.1)
        return {"x": np.array([self.x])}

    def step(self, action):
        self.x += float(action[0])
        return StepResult({"x": np.array([self.x])}, reward=1.0, success=self.x > 1)


class Push:
    name = "push"

    def __init__(self, by):
        self.by = by

    def reset(self, rng):
        self.by += 0.0 * rng.uniform()

    def act(self, observation):
        return Decision(np.array([self.by]))


class Log:
    def __init__(self):
        self.events = []

    def begin(self, world, observation):
        self.events.append("begin")

    def step(self, world, transition):
        if transition.step == 3 and transition.decision.action[0] < 0:
            raise KeyboardInterrupt
        self.events.append((transition.step, transition.done))

    def end(self, success):
        self.events.append(f"end {success}")

    def abort(self):
        self.events.append("abort")


def test_an_episode_ends_when_the_task_stays_solved() -> None:
    log = Log()
    outcome = rollout(Line(), Push(0.5), [log], np.random.default_rng(0), horizon=10, hold_steps=2)
    assert outcome == Outcome(
        steps=3 + (outcome.steps == 4), success=True, reward=float(outcome.steps), clipped=0, failure=""
    )
    assert log.events[0] == "begin"
    assert log.events[-2:] == [(outcome.steps - 1, True), "end True"]


def test_an_episode_ends_at_the_horizon() -> None:
    outcome = rollout(Line(), Push(0.0), [], np.random.default_rng(0), horizon=10, hold_steps=1)
    assert outcome == Outcome(steps=10, success=False, reward=10.0, clipped=0, failure="")


class Fragile(Line):
    """Its physics breaks beyond 0.5."""

    def step(self, action):
        result = super().step(action)
        return replace(result, success=True, clipped=True, failure="it broke" if self.x > 0.5 else "")


def test_an_episode_that_cannot_go_on_has_failed_with_the_reason() -> None:
    outcome = rollout(Fragile(), Push(0.2), [], np.random.default_rng(0), horizon=10, hold_steps=1000)
    assert outcome == Outcome(steps=3, success=False, reward=3.0, clipped=3, failure="it broke")


def test_observers_hear_of_an_episode_that_is_broken_off() -> None:
    log = Log()
    with pytest.raises(KeyboardInterrupt):
        rollout(Line(), Push(-0.1), [log], np.random.default_rng(0), horizon=10, hold_steps=1)
    assert log.events == ["begin", (0, False), (1, False), (2, False), "abort"]


def test_an_episode_can_begin_anywhere() -> None:
    start = WorldState(model_xml="", sim=np.array([0.9]), memory={})
    outcome = rollout(
        Line(),
        Push(0.2),
        [],
        np.random.default_rng(0),
        horizon=10,
        hold_steps=1,
        start=start,
    )
    assert outcome.steps == 1
