"""In which of lfd's worlds a demonstration of robosuite belongs: task, robot, controller and rate."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfd.convert.hdf5.demo_file import SKIP, Demo, DemoFile, rate_of
from lfd.core.errors import EpisodeError, RecordingError, UnknownName
from lfd.worlds.robots import CONTROLLERS, RobotConfig, load_robot, robot_names
from lfd.worlds.tasks import TASKS, load_task

MAP = "Its stored observations can be converted without a simulator: name them in [map.NAME] tables of the recipe."
USUAL: Mapping[str, Any] = {
    "input_max": 1,
    "input_min": -1,
    "kp": 150,
    "damping_ratio": 1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "impedance_mode": "fixed",
    "uncouple_pos_ori": True,
    "interpolation": None,
}
"""robosuite's settings of OSC, which lfd uses."""
CLOCK_TOLERANCE_S = 1e-3
"""How far the recorded clock may be from one control step between two states [s]."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """The world that a demonstration is replayed in."""

    task: str
    robot_name: str
    """Name of the robot config."""
    robot: RobotConfig
    controller: str
    controller_differs: str
    """What of the recorded controller differs from lfd's of that name; empty if nothing."""
    control_hz: int


def setting_of(file: DemoFile, demo: Demo) -> Setting:
    """The world of a demonstration.

    Raises `UnknownName` for an environment, robot or controller that lfd does not know, `RecordingError` for
    actions that are absolute poses or robots that differ, `EpisodeError` when the recorded clock jumps.
    """
    if file.env_name not in TASKS:
        raise UnknownName(f"environment in {file.path}:", file.env_name, TASKS, MAP)
    hz = rate_of(file, demo)
    _check_clock(file, demo, hz)
    name = _robot_name(file)
    part = _arm_controller(file.controllers)
    config = load_robot(name)
    controller = str(part.get("type", config.controller))
    if controller not in CONTROLLERS:
        raise UnknownName(f"controller in {file.path}:", controller, CONTROLLERS, MAP)
    if part.get("control_delta") is False or part.get("input_type") == "absolute":
        raise RecordingError(
            f"{file.path}: its actions are absolute poses, lfd's controllers take changes; take the file with relative "
            "actions that it was made from"
        )
    differs = [f"{key} {part[key]} (here {usual})" for key, usual in USUAL.items() if _differs(part, key, usual)]
    return Setting(
        task=load_task(file.env_name).name,
        robot_name=name,
        robot=config,
        controller=controller,
        controller_differs=", ".join(differs) if controller.startswith("OSC") else "",
        control_hz=hz,
    )


def _robot_name(file: DemoFile) -> str:
    known = {load_robot(name).robosuite_name: name for name in robot_names()}
    robots = set(file.robots)
    if len(robots) != 1:
        given = "does not name its robot" if not robots else f"has different robots: {', '.join(file.robots)}"
        raise RecordingError(f"{file.path} {given}; lfd has {', '.join(sorted(known))}, one kind in a task. {MAP}")
    (robot,) = robots
    if robot not in known:
        raise UnknownName(f"robot in {file.path}:", robot, known, MAP)
    return known[robot]


def _arm_controller(controllers: Mapping[str, Any]) -> Mapping[str, Any]:
    """The configuration of the arm: the whole before robosuite 1.5, a body part since."""
    parts = controllers.get("body_parts", controllers)
    parts = parts.get("arms", parts)
    return next((parts[side] for side in ("right", "left") if isinstance(parts.get(side), dict)), parts)


def _differs(part: Mapping[str, Any], key: str, usual: Any) -> bool:
    if key not in part:
        return False
    here, there = (np.ravel(np.array(value, dtype=object)) for value in (usual, part[key]))
    short = min(len(here), len(there))  # OSC_POSITION has three, and one may stand for all
    return list(here[:short]) != list(there[:short])


def _check_clock(file: DemoFile, demo: Demo, hz: int) -> None:
    if demo.states is None:
        return
    late = np.abs(np.diff(demo.states[:, 0]) - 1 / hz) > CLOCK_TOLERANCE_S
    if late.any():
        at = int(np.argmax(late)) + 1
        raise EpisodeError(
            f"{file.path} {demo.name}: 'states' row {at} stands {demo.states[at, 0] - demo.states[at - 1, 0]:.4f} s "
            f"after the one before, {hz} Hz puts it {1 / hz:.4f} s after; {SKIP}"
        )
