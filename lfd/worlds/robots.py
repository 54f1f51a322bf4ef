"""Robot configs: which robosuite robot, and how its arm is controlled."""

from dataclasses import dataclass
from pathlib import Path

from lfd.core.errors import UnknownName
from lfd.core.recipe import build, load_toml

FOLDER = "robot_configs"
CONTROLLERS = {
    "OSC_POSE": ("x", "y", "z", "rx", "ry", "rz"),
    "OSC_POSITION": ("x", "y", "z"),
    "JOINT_POSITION": (),
    "JOINT_VELOCITY": (),
    "JOINT_TORQUE": (),
}
"""Arm controllers and the names of their action components.

OSC: changes of the grip site's pose in the frame of the robot's base, as fractions of the controller's output
range (0.05 m and 0.5 rad). JOINT: one component for each joint of the arm, as a fraction of 0.05 rad (a change of
position), 0.5 rad/s or 0.1 N m (beside gravity)."""


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """The `[robot]` table of a file in `robot_configs/`."""

    robosuite_name: str
    """Name of the robot in robosuite, for example Panda."""
    controller: str
    """Controller of the arm: OSC_POSE, OSC_POSITION, JOINT_POSITION, JOINT_VELOCITY or JOINT_TORQUE."""

    def check(self, where: str) -> None:
        if self.controller not in CONTROLLERS:
            raise UnknownName(f"controller in {where}:", self.controller, CONTROLLERS)


def config_folder() -> Path:
    """The folder `robot_configs/` of the current directory, else the one that came with lfd."""
    package = Path(__file__).parents[1]
    places = [Path(FOLDER), package / FOLDER, package.parent / FOLDER]  # here, in a wheel, in a checkout
    return next((place for place in places if place.is_dir()), places[0])


def robot_names() -> list[str]:
    """Names of all robot configs."""
    return sorted(path.stem for path in config_folder().glob("*.toml"))


def load_robot(name: str) -> RobotConfig:
    """The robot config called `name`.

    Raises `UnknownName` with the names of all configs.
    """
    path = config_folder() / f"{name}.toml"
    if not path.is_file():
        raise UnknownName("robot", name, robot_names(), f"Robots are files in {config_folder()}.")
    return build(RobotConfig, load_toml(path, ["robot"]).get("robot", {}), f"{path} [robot]")
