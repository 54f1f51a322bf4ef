"""Noise on a demonstrator's actions, so that demonstrations also show how to recover.

The noise is injected into what is applied, the demonstrator's own action is kept as the label (DART: Laskey
et al. 2017, "DART: Noise Injection for Robust Imitation Learning").
"""

from collections.abc import Sequence

import numpy as np

from lfd.core.protocols import Decision, Observation, Policy


class NoisyPolicy:
    """A policy whose applied actions carry noise; `expert_action` is what it meant.

    The noise is a first-order autoregressive process with standard deviation `scale` (in units of the
    action) and correlation `persistence` from step to step, so that it pushes the arm off its way instead of
    shaking it. Grippers are left alone: `names` are those of the action's components.
    """

    def __init__(self, policy: Policy, names: Sequence[str], *, scale: float, persistence: float = 0.8):
        self.name = policy.name
        self._policy, self._shaken = policy, [i for i, name in enumerate(names) if not name.endswith("gripper")]
        self._scale, self._persistence = scale, persistence

    def reset(self, rng: np.random.Generator) -> None:
        self._policy.reset(rng)
        self._rng = rng
        self._noise: float | np.ndarray = 0.0

    def act(self, observation: Observation) -> Decision:
        meant = self._policy.act(observation).action
        fresh = self._rng.normal(scale=self._scale, size=len(self._shaken))
        keep = self._persistence
        self._noise = keep * self._noise + np.sqrt(1 - keep**2) * fresh
        applied = meant.copy()
        applied[self._shaken] += self._noise
        return Decision(np.clip(applied, -1.0, 1.0), expert_action=meant)
