"""Scenes that arms plan in: where things are, and where the arm starts and ends."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from lfd.core.errors import InputError
from lfd.planning.kinematics import GRIPPER, Arm, forward, pull_back
from lfd.planning.signed_distances import Box, Capsule, Floor, Shape
from lfd.rewards.arm_features import Places, Spot

TABLE_HEIGHT_M = 0.8
"""Of robosuite's tables, in the world frame."""
CUP_START_M, CUP_GOAL_M = (-0.08, -0.30, 1.00), (-0.08, 0.30, 1.00)
LAPTOP_M, LAPTOP_HALF_M = (-0.15, -0.03, 0.83), (0.10, 0.14, 0.03)
PERSON_M = (0.30, 0.08, 1.15)
"""The chest of a person who stands, bent over, at the far side of the table."""
PERSON_RADIUS_M = 0.12
NEAR_PERSON_M, NEAR_LAPTOP_M = 0.5, 0.3
"""Distances from which on the gripper is not near [m]."""
NEAR = 0.03
"""What a radian from the wanted posture counts as, in metres."""
PASSES = 5


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scene for one arm, in the world frame."""

    name: str
    places: Places
    """What features refer to."""
    shapes: tuple[Shape, ...]
    """What the arm must not touch."""
    start: Float[np.ndarray, "D"]
    """Joint positions in the beginning [rad]."""
    goal: Float[np.ndarray, "D"]
    """Joint positions in the end [rad]; only a first guess where a planner is free to choose them."""


def cup_scene(arm: Arm) -> Scene:
    """Carry a cup past a person and a laptop, the tasks of Bajcsy et al. 2017 on robosuite's table.

    The straight way from the right to the left of the table leads over the laptop's far edge; beyond it stands the
    person, and nearer to the robot the laptop's middle. Raises `InputError` when the arm does not reach start or goal.
    """
    start = reach(arm, np.array(CUP_START_M), arm.home)
    goal = reach(arm, np.array(CUP_GOAL_M), start)
    person = Capsule((PERSON_M[0], PERSON_M[1], 0.0), PERSON_M, PERSON_RADIUS_M)
    return Scene(
        name="cup",
        places=Places(
            table_height=TABLE_HEIGHT_M,
            person=Spot(np.array(PERSON_M), NEAR_PERSON_M),
            laptop=Spot(np.array(LAPTOP_M), NEAR_LAPTOP_M),
            goal=forward(arm, goal[None]).points[0, GRIPPER],
        ),
        shapes=(Floor(TABLE_HEIGHT_M), Box(LAPTOP_M, LAPTOP_HALF_M), person),
        start=start,
        goal=goal,
    )


def reach(arm: Arm, position: Float[np.ndarray, "3"], near: Float[np.ndarray, "D"]) -> Float[np.ndarray, "D"]:
    """Joint positions [rad] that hold the cup upright with the gripper at `position` [m], as near `near` as can be.

    Least squares within the joint limits of (p(q) - position, axis(q) - z, NEAR (q - near)), and again from where that
    ended with `near` there, so that the last term has ever less to say (the proximal point method). Raises `InputError`
    when the gripper stays more than 1 mm away or the cup tilts by more than 1 degree.
    """
    joints = np.clip(near, arm.low + 1e-6, arm.high - 1e-6)
    for _ in range(PASSES):
        found = least_squares(
            _reach_residuals,
            joints,
            jac=_reach_jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(arm.low, arm.high),
            args=(arm, position, near),
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        joints = near = found.x
    poses = forward(arm, joints[None])
    away, tilt = np.linalg.norm(poses.points[0, GRIPPER] - position), np.arccos(min(1.0, poses.cup_axis[0, 2]))
    if away > 1e-3 or tilt > np.radians(1.0):
        raise InputError(
            f"the arm of {arm.robot!r} does not reach {position} m with an upright cup: it stays {1e3 * away:.0f} mm "
            f"away, tilted by {np.degrees(tilt):.0f} degrees; give a position nearer to its base"
        )
    return joints


def _reach_residuals(joints, arm: Arm, position, near) -> Float[np.ndarray, "R"]:
    poses = forward(arm, joints[None])
    upright = poses.cup_axis[0] - np.array([0.0, 0.0, 1.0])
    return np.concatenate([poses.points[0, GRIPPER] - position, upright, NEAR * (joints - near)])


def _reach_jacobian(joints, arm: Arm, *_about: np.ndarray) -> Float[np.ndarray, "R D"]:
    poses = forward(arm, np.repeat(joints[None], 6, axis=0))
    point_slopes, cup_slopes = np.zeros_like(poses.points), np.zeros_like(poses.cup_axis)
    point_slopes[range(3), GRIPPER, range(3)] = 1.0
    cup_slopes[range(3, 6), range(3)] = 1.0
    return np.concatenate([pull_back(arm, poses, point_slopes, cup_slopes), NEAR * np.eye(arm.joints)])
