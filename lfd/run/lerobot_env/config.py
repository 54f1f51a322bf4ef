"""The environment `lfd` as LeRobot's commands configure it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from lfd.core.channels import ENVIRONMENT_STATE, STATE
from lfd.core.errors import InputError
from lfd.run.lerobot_env.setting import IMAGES, Setting, read_setting
from lfd.run.lerobot_env.worlds import KEYS, PolicyEnv, ThreadedWorlds

TYPES = {STATE: FeatureType.STATE, ENVIRONMENT_STATE: FeatureType.ENV}


@EnvConfig.register_subclass("lfd")
@dataclass
class LfdEnvConfig(EnvConfig):
    """The world that a dataset was recorded in, seen through the dataset's features.

    Raises `InputError` for a folder that is no dataset or policy, and for a robot, controller or rate that is not
    the dataset's unless `force` is set.
    """

    dataset: str = ""
    """Folder of a dataset, or of a policy: it says robot, controller, task and rate, and what the policy sees."""
    task: str | None = None
    """Task, where it is to be another than the dataset's."""
    robot: str | None = None
    """Robot config, where it is to be another than the dataset's; needs `force`."""
    controller: str | None = None
    """Controller of the arm, where it is to be another than the dataset's; needs `force`."""
    fps: int = 0
    """Control steps a second [Hz]; 0 takes the dataset's, another one needs `force`."""
    max_seconds: float = 10.0
    """Simulated time after which an episode has failed [s]."""
    hold_seconds: float = 0.5
    """Simulated time for which the task must stay solved [s]."""
    pictures: bool = True
    """Whether the policy sees the pictures of the dataset's cameras, where it has some."""
    view: str = "frontview"
    """Camera of the videos, where the policy sees none; `none` leaves them black, for machines that cannot draw."""
    force: bool = False
    """Run a policy in a world that it was not trained for."""

    def __post_init__(self) -> None:
        if not self.dataset:
            raise InputError("the environment lfd needs --env.dataset=FOLDER, the dataset that the policy learned from")
        if min(self.max_seconds, self.hold_seconds) <= 0:
            raise InputError(
                f"--env.max_seconds={self.max_seconds} --env.hold_seconds={self.hold_seconds}: must be greater than 0"
            )
        setting = self.setting()
        self.task, self.robot, self.controller = setting.task, setting.robot, setting.controller
        self.fps = setting.control_hz
        self.features = {"action": PolicyFeature(FeatureType.ACTION, (setting.action_size,))}
        self.features_map = {"action": "action"}
        for feature, names in setting.names.items():
            self.features[KEYS[feature]] = PolicyFeature(TYPES[feature], (len(names),))
            self.features_map[KEYS[feature]] = feature
        for camera, size in setting.pictures.items():
            name = f"{IMAGES}{camera}"
            self.features[name] = PolicyFeature(FeatureType.VISUAL, (*size, 3))
            self.features_map[name] = name

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"max_seconds": self.max_seconds, "hold_seconds": self.hold_seconds, "view": self.view}

    def setting(self) -> Setting:
        """The dataset's setting, with what is to be different."""
        found = read_setting(Path(self.dataset))
        for key, name, given in (
            ("robot", "robot", self.robot),
            ("controller", "controller", self.controller),
            ("control_hz", "fps", self.fps),
        ):
            if given and given != getattr(found, key) and not self.force:
                raise InputError(
                    f"--env.{name}={given}, but {self.dataset} is of {getattr(found, key)}: a policy does not carry "
                    f"over; leave --env.{name} out, or add --env.force=true"
                )
        return replace(
            found,
            task=self.task or found.task,
            robot=self.robot or found.robot,
            controller=self.controller or found.controller,
            control_hz=self.fps or found.control_hz,
            pictures=found.pictures if self.pictures else {},
        )

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """`n_envs` worlds, stepped in threads in any case: processes would import LeRobot once more each."""
        setting = self.setting()
        return {self.type: {0: ThreadedWorlds(lambda: PolicyEnv(setting, **self.gym_kwargs), n_envs)}}
