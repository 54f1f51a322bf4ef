"""What tests of the scripted experts share: counting successes, and meddling with an episode."""

from collections.abc import Callable

import mujoco
import numpy as np

from lfd.core.protocols import Decision, Policy
from lfd.worlds.rollout import episode_rng, rollout


def successes(world, policy, seed: int, episodes: int, horizon: int = 300) -> int:
    return sum(
        rollout(world, policy, [], episode_rng("eval", seed, i), horizon=horizon, hold_steps=10).success
        for i in range(episodes)
    )


class Meddled:
    """An expert in whose episodes `happens` may change the world before a step, or decide in the expert's place."""

    name = "meddled"

    def __init__(self, expert, happens: "Callable[[Meddled], Decision | None]"):
        self._expert, self._happens = expert, happens

    def reset(self, rng) -> None:
        self._expert.reset(rng)
        self.rng, self.step, self.at = rng, 0, 0

    def act(self, observation):
        self.step += 1
        return self._happens(self) or self._expert.act(observation)


def once(at: int, change: Callable[[np.random.Generator], object]):
    """`change` the world before step number `at`."""

    def happens(me: Meddled) -> None:
        if me.step == at:
            change(me.rng)

    return happens


def pushed(world, at: int | tuple[int, int]):
    """Half a second of random actions from step `at` on, or from one that each episode draws."""

    def happens(me: Meddled) -> Decision | None:
        if me.step == 1:
            me.at = at if isinstance(at, int) else me.rng.integers(*at)
        size = len(world.spec.action_low)
        return Decision(me.rng.uniform(-1, 1, size)) if me.at <= me.step < me.at + 10 else None

    return happens


def put(world, joint: str, position, quat=(1.0, 0.0, 0.0, 0.0)) -> None:
    """Put a free object somewhere, at rest; upright unless turned."""
    free = world._data.joint(joint)
    free.qpos[:], free.qvel[:] = [*position, *quat], 0.0
    mujoco.mj_forward(world._model, world._data)


def check_same_action(world, make: Callable[[], Policy], steps: int) -> None:
    """Two experts do the same in every state, which is the label and within bounds."""
    first, second = make(), make()
    seen = world.reset(np.random.default_rng(1))
    for _ in range(steps):
        decision = first.act(seen)
        np.testing.assert_array_equal(decision.action, decision.expert_action)
        np.testing.assert_array_equal(decision.action, second.act(seen).action)
        assert np.abs(decision.action).max() <= 1.0
        seen = world.step(decision.action).observation
