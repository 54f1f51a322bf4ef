"""A robosuite world as a Gymnasium environment.

Registered as `lfd/TASK-ROBOT-v0`, for example `lfd/Lift-Panda-v0`, for every task and robot config.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float

from lfd.worlds.robosuite_world import RobosuiteWorld, make_world

BOUND = 1e6
"""Bound of the observation space: far beyond any value, yet finite, so that the space can be sampled."""


class ArmEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An arm and a task.

    Observations are one vector, float64 (Do,); `layout` says which channel (`lfd.core.channels`) stands where and
    `world.spec.labels` names the components. Actions are float32 (Da,) in [-1, 1]. An episode terminates when the
    task has stayed solved for `hold_seconds`, or when the physics becomes unstable; it is truncated after
    `max_seconds`. `info` has `success` (the task is solved now), `clipped` (the action was beyond the limits) and
    `failure` (why the episode could not go on, or nothing).

    Raises `UnknownName` for a task, robot or controller that lfd does not know, `InputError` for an action of
    another shape or one that is not finite.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        robot: str,
        *,
        control_hz: int,
        max_seconds: float,
        hold_seconds: float,
        controller: str | None = None,
    ):
        self.world: RobosuiteWorld = make_world(task, robot, control_hz, controller=controller)
        self._horizon = round(max_seconds * control_hz)
        self._hold_steps = max(1, round(hold_seconds * control_hz))
        self.metadata = {**self.metadata, "render_fps": control_hz}
        spec = self.world.spec
        self.action_space = gymnasium.spaces.Box(
            spec.action_low.astype(np.float32), spec.action_high.astype(np.float32), dtype=np.float32
        )
        self.observation_space = gymnasium.spaces.Box(-BOUND, BOUND, (self.world.observation_size,), dtype=np.float64)

    @property
    def layout(self) -> Mapping[str, slice]:
        """Channel to its place in the observation vector."""
        return self.world.layout

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "Do"], dict[str, Any]]:
        super().reset(seed=seed)
        self.world.reset(self.np_random)
        self._steps = self._held = 0
        return self.world.observe(), {}

    def step(self, action: np.ndarray) -> tuple[Float[np.ndarray, "Do"], float, bool, bool, dict[str, Any]]:
        result = self.world.step(np.asarray(action, dtype=np.float64))
        self._steps += 1
        self._held = self._held + 1 if result.success else 0
        over = bool(result.failure) or self._held >= self._hold_steps
        info = {"success": result.success, "clipped": result.clipped, "failure": result.failure}
        return self.world.observe(), result.reward, over, self._steps >= self._horizon and not over, info
