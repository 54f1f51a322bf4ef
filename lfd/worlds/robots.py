"""Robot configs: which robosuite robot, how its arm is controlled, and how a person's device moves it."""

from dataclasses import dataclass
from pathlib import Path

from lfd.core.errors import RecipeError, UnknownName
from lfd.core.recipe import Table, build, load_toml

FOLDER = "robot_configs"
TABLES = ("robot", "model", "teleop")
FRAMES = ("base", "view", "gripper")
CONTROLLERS = {
    "OSC_POSE": ("x", "y", "z", "rx", "ry", "rz"),
    "OSC_POSITION": ("x", "y", "z"),
    "JOINT_POSITION": (),
    "JOINT_VELOCITY": (),
    "JOINT_TORQUE": (),
    "JOINT_TORQUE_FULL": (),
}
"""Arm controllers and the names of their action components.

OSC: changes of the grip site's pose in the frame of the robot's base, as fractions of the controller's output
range (0.05 m and 0.5 rad). JOINT: one component for each joint of the arm, as a fraction of 0.05 rad (a change of
position), 0.5 rad/s or 0.1 N m (beside gravity). JOINT_TORQUE_FULL is robosuite's JOINT_TORQUE with the joint's largest
torque in the place of 0.1 N m: what an impedance controller of one's own needs."""


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """The `[robot]` table of a file in `robot_configs/`."""

    robosuite_name: str
    """Name of the robot in robosuite, for example Panda."""
    controller: str
    """Controller of the arm, one of `CONTROLLERS`."""
    full_torque_n_m: tuple[float, ...] = ()
    """Torque of each joint at full action of JOINT_TORQUE_FULL [N m]; `load_robot` takes the model's largest."""

    def check(self, where: str) -> None:
        if self.controller not in CONTROLLERS:
            raise UnknownName(f"controller in {where}:", self.controller, CONTROLLERS)


@dataclass(frozen=True, kw_only=True)
class RobotModel:
    """The `[model]` table of a file in `robot_configs/`: what robosuite's model of the robot is like.

    For those who plan with the arm; changing it does not change the simulation. A test compares every number.
    """

    gripper: str
    """Name of the gripper in robosuite; tasks such as Wipe bring their own."""
    home_rad: tuple[float, ...]
    """Joint positions around which a reset draws its start [rad]."""
    cameras: tuple[str, ...]
    """Cameras that the robot carries."""
    low_rad: tuple[float, ...]
    """Lowest position of each joint of the arm; -inf where it turns freely [rad]."""
    high_rad: tuple[float, ...]
    """Highest position of each joint of the arm; inf where it turns freely [rad]."""
    torque_n_m: tuple[float, ...]
    """Largest torque at each joint of the arm [N m]."""
    push_n: float = 40.0
    """Largest force with which a person may push the arm; what is beyond is clipped [N]."""

    def check(self, where: str) -> None:
        sizes = {key: len(getattr(self, key)) for key in ("home_rad", "low_rad", "high_rad", "torque_n_m")}
        if len(set(sizes.values())) > 1:
            raise RecipeError(f"{where}: each joint needs a number in all of {sizes}")


@dataclass(frozen=True, kw_only=True)
class TeleopConfig:
    """The `[teleop]` table of a file in `robot_configs/`: how a person's device moves the robot."""

    frame: str = "view"
    """What the device's directions mean: base (behind the robot), view (facing it) or gripper (turning with it)."""
    position_gain: float = 0.5
    """Translation at full deflection, as a fraction of the controller's full action."""
    rotation_gain: float = 0.2
    """Rotation at full deflection, as a fraction of the controller's full action."""
    dead_band: float = 0.05
    """Deflection that counts as none, as a fraction of the full one; beyond it motion begins at 0."""

    def check(self, where: str) -> None:
        if self.frame not in FRAMES:
            raise UnknownName(f"frame in {where}:", self.frame, FRAMES)
        for key in ("position_gain", "rotation_gain"):
            if not 0 < getattr(self, key) <= 1:
                raise RecipeError(
                    f"{where} {key} = {getattr(self, key)}: must be above 0 and at most 1, the full action"
                )
        if not 0 <= self.dead_band < 1:
            raise RecipeError(f"{where} dead_band = {self.dead_band}: must be at least 0 and below 1")


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
    told = {"full_torque_n_m": list(load_model(name).torque_n_m)} | _table(name, "robot")
    return build(RobotConfig, told, f"{_path(name)} [robot]")


def load_model(name: str) -> RobotModel:
    """What robosuite's model of the robot called `name` is like.

    Raises `UnknownName` with the names of all configs.
    """
    return build(RobotModel, _table(name, "model"), f"{_path(name)} [model]")


def load_teleop(name: str) -> TeleopConfig:
    """How a device moves the robot called `name`; what its config leaves open has the defaults.

    Raises `UnknownName` with the names of all configs.
    """
    return build(TeleopConfig, _table(name, "teleop"), f"{_path(name)} [teleop]")


def _path(name: str) -> Path:
    return config_folder() / f"{name}.toml"


def _table(name: str, table: str) -> Table:
    if not _path(name).is_file():
        raise UnknownName("robot", name, robot_names(), f"Robots are files in {config_folder()}.")
    return load_toml(_path(name), TABLES).get(table, {})
