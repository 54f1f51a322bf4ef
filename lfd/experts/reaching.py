"""What scripted experts share: an arm's hand as it is observed, and the action that brings it to a pose."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.core.protocols import Observation, WorldSpec
from lfd.core.rotations import matrix_from_wxyz, rotvec_between

STEP_M = 0.05
"""Change of the goal position at full action [m]."""
STEP_RAD = 0.5
"""Change of the goal orientation at full action [rad]."""
POSITION_GAIN = 2.0
"""Action, as a multiple of the remaining way in units of STEP_M."""
ROTATION_GAIN = 1.0
"""Action, as a multiple of the remaining turn in units of STEP_RAD."""
OPEN, CLOSE = -1.0, 1.0


@dataclass(frozen=True)
class Hand:
    """A hand as it is observed, in the world frame."""

    position: Float[np.ndarray, "3"]
    """Of the grip site [m]."""
    rotation: Float[np.ndarray, "3 3"]
    """R_world_hand; its z axis points where the fingers do."""

    @classmethod
    def of(cls, observation: Observation, prefix: str = "") -> "Hand":
        """The hand of an arm; `prefix` is that of its channels, such as `robot0_`, where there are two."""
        return cls(observation[f"{prefix}ee_pos"], matrix_from_wxyz(observation[f"{prefix}ee_quat"]))


def check_controller(spec: WorldSpec, task: str) -> None:
    """Raise `InputError` unless the world's arms take changes of the hand's pose."""
    if spec.controller != "OSC_POSE":
        raise InputError(f"the {task} expert drives OSC_POSE, robot {spec.robot!r} has {spec.controller}")


def towards(
    hand: Hand,
    position: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    gripper: float,
    *,
    speed: float = 1.0,
) -> Float[np.ndarray, "7"]:
    """The OSC_POSE action that brings a hand to a pose in the world frame: proportional, at most `speed`."""
    move = POSITION_GAIN * (position - hand.position) / STEP_M
    turn = ROTATION_GAIN * rotvec_between(hand.rotation, rotation) / STEP_RAD
    return np.append(np.clip(np.concatenate([move, turn]), -speed, speed), gripper)


def funnel(distance: float, near: float, far: float) -> float:
    """0 within `near`, 1 beyond `far`, linear in between: how far to stay off, so that actions change gradually."""
    return min(max((distance - near) / (far - near), 0.0), 1.0)


def above(point: Float[np.ndarray, "3"], height: float) -> Float[np.ndarray, "3"]:
    """The point that much higher [m]."""
    return np.array([point[0], point[1], point[2] + height])


def pointing_down(yaw: float) -> Float[np.ndarray, "3 3"]:
    """R_world_hand of a hand that points down, its x axis turned by `yaw` [rad] about the world's z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def nearest_yaw(yaw: float, wanted: float, period: float) -> float:
    """The angle nearest to `yaw` among wanted + k period [rad]."""
    return wanted + period * round((yaw - wanted) / period)


def yaw_of(rotation: Float[np.ndarray, "3 3"]) -> float:
    """Angle of a frame's x axis about the world's z [rad]."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def side_yaw(rotation: Float[np.ndarray, "3 3"]) -> float:
    """Angle about the world's z of a side of a box [rad], whichever face it lies on: that of its most level axis."""
    axis = rotation[:, np.argmin(np.abs(rotation[2]))]
    return float(np.arctan2(axis[1], axis[0]))
