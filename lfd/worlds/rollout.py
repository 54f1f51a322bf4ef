"""The one closed loop: a policy acts in a world while observers watch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lfd.core.protocols import Observer, Policy, Transition, World, WorldState

STAGES = ("record", "eval")


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


def episode_rng(stage: str, seed: int, index: int) -> np.random.Generator:
    """The generator of episode `index` of a run.

    Stages draw from separate streams, so that an evaluation never starts where a demonstration of the same
    seed did.
    """
    return np.random.default_rng([STAGES.index(stage), seed, index])


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
    """Run one episode.

    It starts at `start`, or where the world's reset draws from `rng`, and ends when the task has been
    solved for `hold_steps` steps in a row (its success), or after `horizon` steps. Both the world and the
    policy take their randomness from `rng`, the world first.
    """
    observation = world.set_state(start) if start is not None else world.reset(rng)
    policy.reset(rng)
    reward, held, clipped, step, failure = 0.0, 0, 0, 0, ""
    try:
        for observer in observers:
            observer.begin(world, observation)
        for step in range(horizon):
            decision = policy.act(observation)
            result = world.step(decision.action)
            reward += result.reward
            held = held + 1 if result.success else 0
            clipped, failure = clipped + result.clipped, result.failure
            done = bool(failure) or held >= hold_steps or step + 1 == horizon
            for observer in observers:
                observer.step(world, Transition(step, observation, decision, result, done))
            observation = result.observation
            if done:
                break
        outcome = Outcome(step + 1, held >= hold_steps and not failure, reward, clipped, failure)
        for observer in observers:
            observer.end(outcome.success)
    except BaseException:
        for observer in observers:
            observer.abort()
        raise
    return outcome
