"""Whether a dataset fits the robot that it says it is of, and the policy that training is to begin with."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lfd.core.errors import DatasetError
from lfd.data.frames import Frames
from lfd.worlds.robots import CONTROLLERS, load_robot, robot_names

GRIPPER = "gripper"


def check_robot(frames: Frames, about: Mapping[str, Any], dataset: Path) -> None:
    """Compare a dataset with its manifest and its robot's config; robots that have no config are taken at their word.

    Raises `DatasetError` with both sides where they differ.
    """
    if frames.fps != about["control_hz"]:
        _refuse(dataset, "frames a second", frames.fps, f"{dataset}/manifest.json", about["control_hz"])
    if about["robot"] not in robot_names():
        return
    robot = load_robot(about["robot"])
    if robot.controller != about["controller"]:
        _refuse(dataset, "controller", about["controller"], f"robot config {about['robot']!r}", robot.controller)
    arm, has = CONTROLLERS[robot.controller], frames.names["action"]
    if arm and {name for name in has if not name.endswith(GRIPPER)} != _of_arms(arm, has):
        _refuse(dataset, "action", has, f"{robot.controller} of {about['robot']!r}", [*arm, GRIPPER])


def check_policy(frames: Frames, about: Mapping[str, Any], dataset: Path, policy: Path) -> None:
    """Compare a dataset with the policy that its training begins with, by the manifest of the policy.

    Raises `DatasetError` with both sides where names, sizes, units or rates differ.
    """
    wanted = {**about["features"], "action": about["action"]}
    if frames.fps != about["control_hz"]:
        _refuse(dataset, "frames a second", frames.fps, str(policy), about["control_hz"])
    if set(frames.names) != set(wanted):
        _refuse(dataset, "features", sorted(frames.names), str(policy), sorted(wanted))
    for feature, names in wanted.items():
        if list(frames.names[feature]) != list(names):
            _refuse(dataset, f"{feature}", frames.names[feature], str(policy), names)
        if list(frames.units.get(feature, ())) != list(about["units"].get(feature, ())):
            theirs = about["units"].get(feature, ())
            _refuse(dataset, f"units of {feature}", frames.units.get(feature, ()), str(policy), theirs)


def _of_arms(arm: Sequence[str], names: Sequence[str]) -> set[str]:
    """The components of one arm, or of each of two whose names begin with the arm's."""
    prefixes = {name.removesuffix(GRIPPER) for name in names if name.endswith(GRIPPER)} or {""}
    return {prefix + part for prefix in prefixes for part in arm}


def _refuse(dataset: Path, what: str, has: Any, other: str, wants: Any) -> None:
    raise DatasetError(
        f"{dataset} does not fit {other}: {what}\n  dataset: {_listed(has)}\n  {other}: {_listed(wants)}\n"
        "convert the recordings again with a fitting recipe, or train for this dataset from the beginning"
    )


def _listed(value: Any) -> str:
    return f"{len(value)} ({', '.join(value)})" if isinstance(value, (list, tuple)) else str(value)
