"""Whether the compiled step gives robosuite's numbers.

The yardstick is robosuite itself: contacts are chaotic, so that two runs of robosuite whose start states differ in
the last bit may differ visibly after a few control steps. The compiled step has to stay within a tolerance of
robosuite; at the first control step at which it does not, robosuite must have come as far from itself. What
follows that step is two chaotic motions, of which nothing can be said.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.worlds.steppers import make_stepper

TOLERANCE = 1e-9
"""Difference of any component of qpos, qvel and ctrl that is taken for equal."""
PERTURBATION = 1e-15
"""By how much the start state's qpos is moved to see how far robosuite comes from itself."""
PERTURBED_RUNS = 64
"""Perturbed runs before the compiled step is held to be further away; the first that is as far ends the search."""


@dataclass(frozen=True)
class Comparison:
    """Greatest differences in qpos, qvel and ctrl over the control steps of a comparison."""

    equal_steps: int
    """Control steps after which the compiled step's numbers were robosuite's within the tolerance."""
    ours: float
    """Of the compiled step from robosuite's, in those steps and the one after them."""
    itself: float
    """Of robosuite from robosuite with its start state moved, in the same steps; 0 where it was not asked."""

    @property
    def is_same(self) -> bool:
        return self.ours <= max(TOLERANCE, self.itself)


def compare(world: Any, actions: Sequence[Float[np.ndarray, "Da"]]) -> Comparison:
    """Apply `actions` from a robosuite world's present state, compiled and by robosuite, and come back to it."""
    start = world.get_state()
    theirs = _run(world, start, "robosuite", actions)
    away = np.abs(_run(world, start, "compiled", actions) - theirs).max(axis=1)
    equal = int(np.argmin(np.append(away <= TOLERANCE, False)))
    ours, itself = float(away[: equal + 1].max()), 0.0
    for run in range(PERTURBED_RUNS):
        if ours <= max(TOLERANCE, itself):
            break
        moved = _run(world, start, "robosuite", actions[: equal + 1], np.random.default_rng(run))
        itself = max(itself, float(np.abs(moved - theirs[: equal + 1]).max()))
    world.set_state(start)
    return Comparison(equal, ours, itself)


def _run(
    world: Any, start: Any, name: str, actions: Sequence[np.ndarray], mover: np.random.Generator | None = None
) -> Float[np.ndarray, "T _"]:
    """qpos, qvel and ctrl after each of the actions."""
    world.set_state(start)
    model, data = world._model, world._data
    if mover is not None:
        data.qpos[:] += PERTURBATION * mover.choice([-1.0, 1.0], model.nq)
        mujoco.mj_step1(model, data)
    stepper, rows = make_stepper(name, world._env), []
    for action in actions:
        stepper.step(action)
        rows.append(np.concatenate([data.qpos, data.qvel, data.ctrl]))
    stepper.store()
    return np.array(rows)
