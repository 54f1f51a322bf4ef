"""A policy that repeats recorded actions, whatever it sees."""

import numpy as np
from jaxtyping import Float

from lfd.core.protocols import Decision, Observation


class PlaybackPolicy:
    """Row t of `actions` in step t."""

    name = "playback"

    def __init__(self, actions: Float[np.ndarray, "T Da"]):
        self._actions = actions

    def reset(self, rng: np.random.Generator) -> None:
        self._next = iter(self._actions)

    def act(self, observation: Observation) -> Decision:
        return Decision(next(self._next))
