from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lfd.core.protocols import Decision, StepResult, WorldState
from lfd.worlds.rollout import OneEach, Outcome, Start, branch, rollout, rollouts


class Line:
    """A point on a line; the action moves it, beyond 1 the task is solved."""

    spec: Any = None

    def sim_state(self):
        return np.array([self.x])

    def pictures(self):
        return {}

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


class Shy:
    """Moves by a random amount; asked in one go for all worlds."""

    name = "shy"

    def __init__(self):
        self.asked, self.rngs = [], {}

    def reset(self, place, rng):
        self.rngs[place] = rng

    def act(self, places, observations):
        self.asked.append(tuple(places))
        assert len(places) == len(observations)
        return [Decision(self.rngs[place].uniform(0, 0.5, 1)) for place in places]


def run_many(n: int) -> tuple[dict[int, Outcome], Shy]:
    policy = Shy()
    starts = iter([Start(index=i, rng=np.random.default_rng(i)) for i in range(10)])
    worlds = [Line() for _ in range(n)]
    ended = rollouts(worlds, policy, lambda: next(starts, None), horizon=20, hold_steps=1)
    return {start.index: outcome for start, outcome in ended}, policy


def test_outcomes_do_not_depend_on_the_number_of_worlds() -> None:
    alone, _ = run_many(1)
    assert sorted(alone) == list(range(10))
    assert len(set(alone.values())) > 1
    for n in (2, 7, 20):
        together, policy = run_many(n)
        assert together == alone
        assert len(policy.asked[0]) == min(n, 10)  # once for all


def test_branches_from_one_state_differ_by_their_generators_alone() -> None:
    state = WorldState(model_xml="", sim=np.array([0.5]), memory={})
    outcomes = [
        branch(
            [Line() for _ in range(n)],
            state,
            Shy(),
            list(map(np.random.default_rng, [3, 4, 3])),
            horizon=9,
            hold_steps=1,
        )
        for n in (1, 2)
    ]
    assert outcomes[0] == outcomes[1]
    first, second, again = outcomes[0]
    assert first == again != second


def test_an_error_in_one_world_breaks_all_episodes_off() -> None:
    logs = [Log(), Log()]
    starts = iter([Start(index=i, rng=np.random.default_rng(0), observers=[log]) for i, log in enumerate(logs)])
    with pytest.raises(KeyboardInterrupt):
        list(
            rollouts(
                [Line(), Line()],
                OneEach([Push(-0.1), Push(0.01)]),
                lambda: next(starts, None),
                horizon=10,
                hold_steps=1,
            )
        )
    assert [log.events[-1] for log in logs] == ["abort", "abort"]
