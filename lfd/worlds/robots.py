"""Robot configs: which robosuite robot, and how its arm is controlled."""

from dataclasses import dataclass
from pathlib import Path

from lfd.core.errors import UnknownName
from lfd.core.recipe import build, load_toml

FOLDER = "robot_configs"
CONTROLLERS = {
    "OSC_POSE": ("x", "y", "z", "rx", "ry", "rz"),
    "OSC_POSITION": ("x", "y", "z"),
}
"""Arm controllers and the names of their action components: changes of the grip site's pose in the frame
of the robot's base, as fractions of the controller's output range (0.05 m and 0.5 rad)."""


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """The `[robot]` table of a file in `robot_configs/`."""

    robosuite_name: str
    """Name of the robot in robosuite, for example Panda."""
    controller: str
    """Controller of the arm: OSC_POSE or OSC_POSITION."""

    def check(self, where: str) -> None:
        if self.controller not in CONTROLLERS:
            raise UnknownName(f"controller in {where}:", self.controller, CONTROLLERS)


def config_folder() -> Path:
    """The folder `robot_configs/` of the current directory, else the one that came with lfd."""
    package = Path(__file__).parents[1]
    places = [Path(FOLDER), package / FOLDER, package.parent / FOLDER]  # here, in a wheel, in a checkout
    return next((place for place in places if place.is_dir()), places[0])


def load_robot(name: str) -> RobotConfig:
    """The robot config called `name`.

    Raises `UnknownName` with the names of all configs.
    """
    folder = config_folder()
    path = folder / f"{name}.toml"
    if not path.is_file():
        raise UnknownName("robot", name, [p.stem for p in folder.glob("*.toml")], f"Robots are files in {folder}.")
    return build(RobotConfig, load_toml(path, ["robot"]).get("robot", {}), f"{path} [robot]")
