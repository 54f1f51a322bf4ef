"""The scripted expert for Lift.

A state-feedback policy: which of its three moves it makes is read from the present observation alone, so it
can be asked in any state, also in one that it would never have reached (DAgger does so).

    carry      the fingers have stopped on the cube  -> up to the carrying height
    grasp      the fingers are around the cube       -> close
    descend    otherwise                             -> down a funnel onto the cube, open

The funnel makes the action change gradually with the state: the further the gripper is beside the cube, the
higher it stays. The gripper points down along the axes of the world whatever the cube's yaw is: its pads hold
a cube by its edges as well as by its sides, and turning to the sides would make the action jump at each
eighth of a turn, which an imitator learns badly from few demonstrations.
"""

import numpy as np

from lfd.core.errors import InputError
from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.core.rotations import matrix_from_wxyz, rotvec_between

STEP_M = 0.05
"""Change of the goal position at full action [m]."""
STEP_RAD = 0.5
"""Change of the goal orientation at full action [rad]."""
POSITION_GAIN = 2.0
"""Action, as a multiple of the remaining way in units of STEP_M."""
ROTATION_GAIN = 1.0
HOVER_M = 0.06
"""Height above the cube at which the gripper is brought over it [m]."""
FUNNEL_M = (0.008, 0.030)
"""Horizontal distance below which the gripper goes all the way down, and above which it hovers [m]."""
AROUND_M = 0.015
"""Distance at which the fingers are around the cube [m]."""
CARRY_M = 0.95
"""Height to which the cube is lifted, 0.15 m above the table [m]."""
HELD_WIDTH_M = (0.030, 0.066)
"""Opening of the fingers when they hold the cube: 0.040 m by its sides to 0.063 m by its edges [m]."""
STOPPED_M_S = 0.02
"""Speed of each finger below which it has stopped [m/s]; closing freely they move at 0.07 m/s."""

OPEN, CLOSE = -1.0, 1.0
DOWN = np.array([0.0, 0.0, -1.0])


class LiftExpert:
    """Lifts the cube with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "lift_expert"

    def __init__(self, spec: WorldSpec):
        if spec.controller != "OSC_POSE":
            raise InputError(f"the Lift expert drives OSC_POSE, robot {spec.robot!r} has {spec.controller}")

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to forget: the expert has no memory and no randomness."""

    def act(self, observation: Observation) -> Decision:
        ee, cube = observation["ee_pos"], observation["cube_pos"]
        away = ee - cube
        sideways = float(np.hypot(away[0], away[1]))
        width = float(np.ptp(observation["gripper_pos"]))
        stopped = float(np.abs(observation["gripper_vel"]).max()) < STOPPED_M_S
        around = sideways < AROUND_M and abs(away[2]) < AROUND_M
        if around and stopped and HELD_WIDTH_M[0] < width < HELD_WIDTH_M[1]:
            target, gripper = np.array([cube[0], cube[1], CARRY_M]), CLOSE
        elif around:
            target, gripper = cube, CLOSE
        else:
            off = (sideways - FUNNEL_M[0]) / (FUNNEL_M[1] - FUNNEL_M[0])
            target, gripper = cube - HOVER_M * min(max(off, 0.0), 1.0) * DOWN, OPEN
        move = POSITION_GAIN * (target - ee) / STEP_M
        turn = ROTATION_GAIN * turn_downwards(observation["ee_quat"]) / STEP_RAD
        action = np.clip(np.concatenate([move, turn, [gripper]]), -1.0, 1.0)
        return Decision(action, expert_action=action)


def turn_downwards(ee_quat: np.ndarray) -> np.ndarray:
    """Rotation vector [rad], world frame, to the nearest pose that points down along the axes of the world."""
    gripper = matrix_from_wxyz(ee_quat)
    quarter = np.pi / 2
    yaw = quarter * np.round(np.arctan2(gripper[1, 0], gripper[0, 0]) / quarter)
    x_axis = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return rotvec_between(gripper, np.column_stack([x_axis, np.cross(DOWN, x_axis), DOWN]))
