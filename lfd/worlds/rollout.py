"""The one closed loop: policies act in worlds while observers watch.

`rollout` runs one episode in one world; `rollouts` runs many in as many worlds as it is given, each in a thread of
its own while the physics runs (which releases Python's lock). Both are the same loop, and what an episode does
depends on its generator alone: not on how many worlds there are, which of them it gets, or how fast they are.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from lfd.core.protocols import (
    BatchPolicy,
    Decision,
    Observation,
    Observer,
    Policy,
    Transition,
    Verdict,
    World,
    WorldState,
)

STAGES = ("record", "eval", "judge", "dagger", "watch")
"""What has a random stream of its own; the order is part of the seed."""


@dataclass(frozen=True)
class Outcome:
    """How a rollout ended."""

    steps: int
    """Control steps taken."""
    success: bool
    """Whether the task was solved, and stayed solved, at the end."""
    reward: float
    """Sum of the rewards, undiscounted."""
    clipped: int
    """Control steps whose action was beyond the controller's limits."""
    failure: str
    """Why the episode could not go on, where it was broken off; else empty."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """An episode to run."""

    index: int
    """Number of the episode in its run."""
    rng: np.random.Generator
    """Source of all randomness in the episode: the world's, then the policy's."""
    observers: Sequence[Observer] = ()
    state: WorldState | None = None
    """Where to begin; without it, where the world's reset draws."""


def episode_rng(stage: str, seed: int, index: int) -> np.random.Generator:
    """The generator of episode `index` of a run.

    Stages draw from separate streams, so that an evaluation never starts where a demonstration of the same
    seed did.
    """
    return np.random.default_rng([STAGES.index(stage), seed, index])


class OneEach:
    """Policies that act one by one, one for each world."""

    def __init__(self, policies: Sequence[Policy]):
        self._policies = policies
        self.name = policies[0].name

    def reset(self, place: int, rng: np.random.Generator) -> None:
        self._policies[place].reset(rng)

    def act(self, places: Sequence[int], observations: Sequence[Observation]) -> Sequence[Decision]:
        return [self._policies[place].act(seen) for place, seen in zip(places, observations, strict=True)]


class _Episode:
    """One episode in one world, between its start and its end."""

    def __init__(self, world: World, start: Start, horizon: int, hold_steps: int):
        self.world, self.start, self.outcome = world, start, Outcome(0, False, 0.0, 0, "")
        self._horizon, self._hold_steps, self._held = horizon, hold_steps, 0

    def begin(self) -> None:
        start = self.start
        self.observation = self.world.reset(start.rng) if start.state is None else self.world.set_state(start.state)

    def step(self, decision: Decision) -> bool:
        """Apply a decision; whether the episode is over. The first step is announced to the observers."""
        was = self.outcome
        if was.steps == 0:
            for observer in self.start.observers:
                observer.begin(self.world, self.observation)
        result = self.world.step(decision.action)
        self._held = self._held + 1 if result.success else 0
        held = self._held >= self._hold_steps and decision.verdict is None
        solved = (held or decision.verdict is Verdict.SUCCESS) and not result.failure
        done = bool(result.failure or decision.verdict) or solved or was.steps + 1 == self._horizon
        for observer in self.start.observers:
            observer.step(self.world, Transition(was.steps, self.observation, decision, result, done))
        self.outcome = Outcome(
            was.steps + 1, solved, was.reward + result.reward, was.clipped + result.clipped, result.failure
        )
        self.observation = result.observation
        if decision.verdict is Verdict.DISCARD:
            self.abort()
        elif done:
            for observer in self.start.observers:
                observer.end(solved)
        return done

    def abort(self) -> None:
        for observer in self.start.observers:
            observer.abort()


def rollouts(
    worlds: Sequence[World],
    policy: BatchPolicy,
    next_start: Callable[[], Start | None],
    *,
    horizon: int,
    hold_steps: int,
) -> Iterator[tuple[Start, Outcome]]:
    """Run episodes in parallel, each handed out when it ends.

    A world that is free asks `next_start` for an episode; none means none at the moment. An episode begins at its
    start state, and ends when the task has been solved for `hold_steps` steps in a row (its success), at a person's
    verdict, when the physics becomes unstable, or after `horizon` steps. Observers are called from the thread that
    steps their world. The policy is asked once for all worlds.
    """
    running: dict[int, _Episode] = {}
    with ThreadPoolExecutor(len(worlds)) as pool:
        each = pool.map if len(worlds) > 1 else map
        try:
            while True:
                fresh = {}
                for place in range(len(worlds)):
                    if place not in running and (start := next_start()) is not None:
                        fresh[place] = _Episode(worlds[place], start, horizon, hold_steps)
                running |= fresh
                if not running:
                    return
                list(each(_Episode.begin, fresh.values()))
                for place, episode in fresh.items():
                    policy.reset(place, episode.start.rng)
                places = sorted(running)
                decisions = policy.act(places, [running[place].observation for place in places])
                ends = list(each(_Episode.step, (running[place] for place in places), decisions))
                for place, is_over in zip(places, ends, strict=True):
                    if is_over:
                        episode = running.pop(place)
                        yield episode.start, episode.outcome
        except BaseException:
            for episode in running.values():
                episode.abort()
            raise


def rollout(
    world: World,
    policy: Policy,
    observers: Sequence[Observer],
    rng: np.random.Generator,
    *,
    horizon: int,
    hold_steps: int,
    start: WorldState | None = None,
) -> Outcome:
    """Run one episode (see `rollouts`).

    It starts at `start`, or where the world's reset draws from `rng`. Both the world and the policy take their
    randomness from `rng`, the world first.
    """
    waiting = [Start(index=0, rng=rng, observers=observers, state=start)]
    episodes = rollouts(
        [world],
        OneEach([policy]),
        lambda: waiting.pop() if waiting else None,
        horizon=horizon,
        hold_steps=hold_steps,
    )
    return next(outcome for _, outcome in episodes)


def branch(
    worlds: Sequence[World],
    state: WorldState,
    policy: BatchPolicy,
    rngs: Sequence[np.random.Generator],
    *,
    horizon: int,
    hold_steps: int,
    observers: Callable[[int], Sequence[Observer]] | None = None,
) -> list[Outcome]:
    """Run one episode for each generator, all from `state`; outcomes in the order of the generators.

    `observers` gives those of the branch with a number. The same generator gives the same branch, bit for bit.
    """
    starts = (
        Start(index=index, rng=rng, observers=observers(index) if observers else (), state=state)
        for index, rng in enumerate(rngs)
    )
    ended = rollouts(worlds, policy, lambda: next(starts, None), horizon=horizon, hold_steps=hold_steps)
    outcomes = {start.index: outcome for start, outcome in ended}
    return [outcomes[index] for index in sorted(outcomes)]
