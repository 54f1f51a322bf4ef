"""Many worlds at once, stepped in threads, as a Gymnasium vector environment."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float

from lfd.core.errors import InputError
from lfd.worlds.gymnasium_env import ArmEnv


class VectorWorld(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """`n` worlds of one task with one robot.

    Observations, actions, rewards and ends are arrays with one row a world, in the order of the worlds. A world
    whose episode is over starts the next one within the same step: its row is then the first observation of the
    new episode, and `infos["final_obs"]`, `infos["final_info"]` hold the last ones of the old.

    Physics runs in one thread for each world. World number i, seeded with seed + i, goes the same way whatever n
    is and however fast the others are.

    Raises `InputError` for n < 1, and what `ArmEnv` raises.
    """

    def __init__(
        self,
        n: int,
        task: str = "Lift",
        robot: str = "panda",
        *,
        control_hz: int = 20,
        max_seconds: float = 10.0,
        hold_seconds: float = 0.5,
        controller: str | None = None,
    ):
        if n < 1:
            raise InputError(f"a vector world needs at least one world, not {n}")
        times = {"control_hz": control_hz, "max_seconds": max_seconds, "hold_seconds": hold_seconds}
        self.envs = [ArmEnv(task, robot, controller=controller, **times) for _ in range(n)]
        self.num_envs = n
        self.metadata = {**self.envs[0].metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = self.envs[0].observation_space
        self.single_action_space = self.envs[0].action_space
        self.observation_space = batch_space(self.single_observation_space, n)
        self.action_space = batch_space(self.single_action_space, n)
        self._pool = ThreadPoolExecutor(n)

    @property
    def layout(self) -> Mapping[str, slice]:
        """Channel to its columns in the observations."""
        return self.envs[0].layout

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "n Do"], dict[str, Any]]:
        seeds = [seed] * self.num_envs if seed is None else seed
        if isinstance(seeds, int):
            seeds = [seeds + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise InputError(f"{len(seeds)} seeds for {self.num_envs} worlds; give one for each, or a single number")
        fresh = self._pool.map(lambda env, own: env.reset(seed=own, options=options), self.envs, seeds)
        return np.stack([observation for observation, _ in fresh]), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[
        Float[np.ndarray, "n Do"], Float[np.ndarray, "n"], Bool[np.ndarray, "n"], Bool[np.ndarray, "n"], dict[str, Any]
    ]:
        if np.shape(actions) != self.action_space.shape:
            raise InputError(
                f"actions have shape {np.shape(actions)}, {self.num_envs} worlds take {self.action_space.shape}"
            )
        stepped = list(self._pool.map(_step, self.envs, actions))
        infos: dict[str, Any] = {}
        for i, (_, _, _, _, info) in enumerate(stepped):
            infos = self._add_info(infos, info, i)
        seen, rewards, terminated, truncated = (np.array(column) for column in list(zip(*stepped, strict=True))[:4])
        return seen, rewards, terminated, truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._pool.shutdown()


def _step(env: ArmEnv, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
    """Step one world, and start its next episode when this one is over."""
    seen, reward, terminated, truncated, info = env.step(action)
    if terminated or truncated:
        last, seen = seen, env.reset()[0]
        info = {"final_obs": last, "final_info": info}
    return seen, reward, terminated, truncated, info
