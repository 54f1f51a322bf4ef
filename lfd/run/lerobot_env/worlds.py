"""Worlds as LeRobot's evaluation loop wants them."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate
from jaxtyping import Int, UInt8

from lfd.core.channels import ENVIRONMENT_STATE, STATE, operands
from lfd.core.errors import InputError
from lfd.core.processes import cores
from lfd.run.lerobot_env.setting import Setting
from lfd.worlds.gymnasium_env import BOUND, ArmEnv

KEYS = {STATE: "agent_pos", ENVIRONMENT_STATE: "environment_state"}
"""Feature to the name by which LeRobot's `preprocess_observation` expects it from an environment."""
NO_VIEW = "none"
VIDEO = 256  # height and width of a video's pictures [pixels]


class PolicyEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """An arm and a task, seen through the features of a dataset.

    Observations are `agent_pos` (Ds,) and `environment_state` (De,), float32, and `pixels`, camera to RGB (H, W, 3).
    `info["is_success"]` is whether the episode has ended with the task solved for `hold_seconds`; in the middle of an
    episode it is false. When the episode is over the world stands still: every further step gives the last
    observation, no reward and the same end, until the next reset. (LeRobot steps a batch until its last episode is
    over, and counts one step past the end of each of the others.)

    Raises `InputError` for features that the world does not have, and what `ArmEnv` raises.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, setting: Setting, *, max_seconds: float, hold_seconds: float, view: str):
        self._arm = ArmEnv(
            setting.task,
            setting.robot,
            controller=setting.controller,
            control_hz=setting.control_hz,
            max_seconds=max_seconds,
            hold_seconds=hold_seconds,
        )
        spec = self._arm.world.spec
        self._columns = {KEYS[feature]: self._find(names) for feature, names in setting.names.items()}
        self._seen_cameras, self._view, self._has_cameras = tuple(setting.pictures), view, False
        self.task, self.task_description = spec.task, spec.instruction
        self._max_episode_steps = round(max_seconds * setting.control_hz)
        self.metadata = {**self.metadata, "render_fps": setting.control_hz}
        self.action_space = self._arm.action_space
        if self.action_space.shape != (setting.action_size,):
            raise InputError(
                f"the policy's actions have {setting.action_size} numbers, {spec.robot} with {spec.controller} takes "
                f"{len(spec.action_low)}"
            )
        spaces: dict[str, gymnasium.Space] = {
            key: Box(-BOUND, BOUND, first.shape, np.float32) for key, (first, _) in self._columns.items()
        }
        if self._seen_cameras:
            self._take_cameras(setting.pictures)
            spaces["pixels"] = Dict(
                [(name, Box(0, 255, (*size, 3), np.uint8)) for name, size in setting.pictures.items()]
            )
        self.observation_space = Dict(spaces)
        self._last: tuple[dict[str, Any], bool, bool, dict[str, Any]] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        self._last = None
        vector, _ = self._arm.reset(seed=seed)
        return self._observe(vector), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        if self._last is not None:
            seen, terminated, truncated, info = self._last
            return seen, 0.0, terminated, truncated, info
        vector, reward, terminated, truncated, told = self._arm.step(action)
        seen, info = self._observe(vector), {"is_success": terminated and not told["failure"]}
        if terminated or truncated:
            self._last = seen, terminated, truncated, info
        return seen, reward, terminated, truncated, info

    def render(self) -> UInt8[np.ndarray, "H W 3"]:
        """What the first of the policy's cameras sees, or else the camera of the videos."""
        if not self._seen_cameras and self._view == NO_VIEW:
            return np.zeros((VIDEO, VIDEO, 3), np.uint8)
        if not self._has_cameras:
            self._take_cameras({self._view: (VIDEO, VIDEO)})
        return next(iter(self._arm.world.pictures().values()))

    def _take_cameras(self, sizes: Mapping[str, tuple[int, int]]) -> None:
        if len(set(sizes.values())) > 1:
            raise InputError(f"the pictures of the cameras {', '.join(sizes)} differ in size; record them in one size")
        height, width = next(iter(sizes.values()))
        self._arm.world.take_cameras(tuple(sizes), height=height, width=width)
        self._has_cameras = True

    def _observe(self, vector: np.ndarray) -> dict[str, Any]:
        seen: dict[str, Any] = {
            key: (vector[first] - np.where(second < 0, 0.0, vector[second])).astype(np.float32)
            for key, (first, second) in self._columns.items()
        }
        if self._seen_cameras:
            seen["pixels"] = dict(self._arm.world.pictures())
        return seen

    def _find(self, names: tuple[str, ...]) -> tuple[Int[np.ndarray, "_"], Int[np.ndarray, "_"]]:
        """Where components such as `ee_pos.x` stand in the world's observation; of differences both, else -1."""
        spec, found = self._arm.world.spec, []
        for name in names:
            channel, _, label = name.partition(".")
            parts = operands(channel)
            if any(part not in self._arm.layout or label not in spec.labels[part] for part in parts):
                raise InputError(f"the dataset has {name!r}, which {spec.task} with {spec.robot} does not observe")
            places = [self._arm.layout[part].start + spec.labels[part].index(label) for part in parts]
            found.append([*places, -1][:2])
        first, second = np.array(found, dtype=int).reshape(-1, 2).T
        return first, second


class ThreadedWorlds(SyncVectorEnv):
    """Several `PolicyEnv`, stepped in threads; nothing is reset but by `reset`."""

    def __init__(self, make: Callable[[], PolicyEnv], n: int):
        super().__init__([make] * n, autoreset_mode=AutoresetMode.DISABLED)
        self._pool = ThreadPoolExecutor(min(n, cores()))

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        stepped = list(self._pool.map(lambda env, action: env.step(action), self.envs, actions))
        seen, rewards, terminated, truncated, infos = zip(*stepped, strict=True)
        self._observations = concatenate(self.single_observation_space, seen, self._observations)
        told = {"is_success": np.array([info["is_success"] for info in infos])}
        return deepcopy(self._observations), np.array(rewards), np.array(terminated), np.array(truncated), told

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._pool.shutdown()
        super().close_extras(**kwargs)
