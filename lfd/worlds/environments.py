"""robosuite environments, built. The only module that imports robosuite."""

import logging
import warnings
import xml.etree.ElementTree as ET
from functools import cache
from typing import Any

import numpy as np

from lfd.worlds.robots import RobotConfig
from lfd.worlds.tasks import Task

PLACED = ("body_pos", "body_quat")
"""Fields of the model that a reset changes: where robosuite places what cannot move, such as a door."""
HOLLOW_MESHES = {"Sawyer": ("_head_1", "_head_4"), "Baxter": ("_H1_1",)}
"""Meshes too flat for the volume that MuJoCo >= 3.3 asks for; it computes their inertia as shells instead."""


LOCKING_CONTACTS = {"Sawyer": (("right_arm_base_link", "right_l0"),)}
"""Bodies whose contact is left out: a sphere of Sawyer's first link stands on the edge of its pedestal, which MuJoCo
does not filter as it does neighbours that both move, and friction there locks the first joint."""
ARENA = "64M"
"""Memory for the contacts and constraints of a step. By robosuite's limits of 5000 contacts and 5000 constraints MuJoCo
would set 1.2 GB aside for each MjData: never touched, but a process with some worlds is then refused a fork."""


@cache
def import_robosuite() -> Any:
    """robosuite, without its messages about optional parts that lfd does not use."""
    logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)  # escape sequences in robosuite's docstrings
        import robosuite
        from robosuite.environments.base import MujocoEnv
        from robosuite.models import robots
        from robosuite.models.world import MujocoWorldBase
    _bound_arena(MujocoWorldBase)
    _remember_places(MujocoEnv)
    for robot, meshes in HOLLOW_MESHES.items():
        _amend(getattr(robots, robot), meshes, LOCKING_CONTACTS.get(robot, ()))
    return robosuite


def make_environment(task: Task, robot: RobotConfig, control_hz: int, **options: Any) -> Any:
    """robosuite's own environment, without rendering; `options` go to `robosuite.make`.

    A task for two arms gets two robots, or one that has two arms.
    """
    robosuite = import_robosuite()
    config = controller_configs(robot)
    quiet = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False}
    return robosuite.make(
        task.name,
        robots=robots_of(task, robot),
        controller_configs=config,
        control_freq=control_hz,
        ignore_done=True,
        **(quiet | options),
    )


def controller_configs(robot: RobotConfig) -> Any:
    """robosuite's configuration of a robot's controllers: its arms' is the robot config's."""
    import_robosuite()
    from robosuite.controllers import load_composite_controller_config, load_part_controller_config
    from robosuite.models.robots.robot_model import REGISTERED_ROBOTS

    arms = REGISTERED_ROBOTS[robot.robosuite_name].arms
    config: Any = load_composite_controller_config(controller="BASIC", robot=robot.robosuite_name)
    name = robot.controller.removesuffix("_FULL")
    parts = {arm: load_part_controller_config(default_controller=name) for arm in arms}
    for arm, part in parts.items():
        part |= {key: config["body_parts"][arm][key] for key in ("gripper", "input_type", "input_ref_frame")}
    if name != robot.controller:
        for part, full in zip(parts.values(), np.split(np.array(robot.full_torque_n_m), len(arms)), strict=True):
            part |= {"output_max": full, "output_min": -full}
    config["body_parts"] = parts
    return config


def robots_of(task: Task, robot: RobotConfig) -> list[str]:
    """robosuite's names of the robots of a task: two for two arms, unless one has both."""
    import_robosuite()
    from robosuite.models.robots.robot_model import REGISTERED_ROBOTS

    return [robot.robosuite_name] * (task.arms // len(REGISTERED_ROBOTS[robot.robosuite_name].arms) or 1)


def _remember_places(environment: Any) -> None:
    """Let robosuite environments keep, as `places_in_xml`, the places that their present model was compiled with."""
    initialize = environment._initialize_sim

    def initialize_and_remember(self: Any, xml_string: str | None = None) -> None:
        initialize(self, xml_string)
        self.places_in_xml = {field: getattr(self.sim.model._model, field).copy() for field in PLACED}

    environment._initialize_sim = initialize_and_remember


def _bound_arena(world: Any) -> None:
    """Let robosuite's worlds ask for `ARENA`."""
    build = world.__init__

    def build_bounded(self: Any) -> None:
        build(self)
        self.root.find("size").attrib = {"memory": ARENA}

    world.__init__ = build_bounded


def _amend(robot: Any, meshes: tuple[str, ...], contacts: tuple[tuple[str, str], ...]) -> None:
    """Let a robosuite robot model compute the inertia of some meshes as shells, and leave out some contacts."""
    build = robot.__init__

    def build_amended(self: Any, *args: Any, **kwargs: Any) -> None:
        build(self, *args, **kwargs)
        for first, second in contacts:
            bodies = {"body1": f"{self.naming_prefix}{first}", "body2": f"{self.naming_prefix}{second}"}
            ET.SubElement(self.contact, "exclude", bodies)
        for mesh in self.asset.iter("mesh"):
            if mesh.get("name", "").endswith(meshes):
                mesh.set("inertia", "shell")

    robot.__init__ = build_amended
