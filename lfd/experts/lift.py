"""The scripted expert for Lift.

A state-feedback policy: which of its three moves it makes is read from the present observation alone, so it
can be asked in any state, also in one that it would never have reached (DAgger does so).

    carry      the fingers have stopped on the cube  -> up to the carrying height
    grasp      the fingers are around the cube       -> close
    descend    otherwise                             -> down a funnel onto the cube, open

The funnel makes the action change gradually with the state: the further the gripper is beside the cube, the
higher it stays. The gripper points down along the axes of the world whatever the cube's yaw is: its pads hold
a cube by its edges as well as by its sides, and turning to the sides would make the action jump at each
eighth of a turn, which an imitator learns badly from few demonstrations. Grippers too narrow for that
(`lfd.experts.grippers`) turn to the sides.
"""

import numpy as np

from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.grippers import gripper_of
from lfd.experts.reaching import (
    CLOSE,
    OPEN,
    Hand,
    above,
    check_controller,
    funnel,
    nearest_yaw,
    pointing_down,
    side_yaw,
    towards,
    yaw_of,
)
from lfd.experts.style import PLAIN, ExpertStyle

HOVER_M = 0.06
"""Height above the cube at which the gripper is brought over it [m]."""
FUNNEL_M = (0.008, 0.030)
"""Horizontal distance below which the gripper goes all the way down, and above which it hovers [m]."""
AROUND_M = 0.015
"""Distance at which the fingers are around the cube [m]."""
CARRY_M = 0.95
"""Height to which the cube is lifted, 0.15 m above the table [m]."""
HELD_WIDTH_M = {True: (0.030, 0.066), False: (0.030, 0.052)}
"""Opening of the fingers when they hold the cube: 0.040 to 0.044 m by its sides, to 0.063 m by its edges, where they
hold these [m]."""
QUARTER = np.pi / 2


class LiftExpert:
    """Lifts the cube with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "lift_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "Lift")
        self._style, self._speed, self._gripper = style, style.speed[1], gripper_of(spec)
        self._held = HELD_WIDTH_M[self._gripper.holds_edges]

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode; beside it the expert has no memory."""
        self._speed = self._style.draw_speed(rng)

    def act(self, observation: Observation) -> Decision:
        hand, cube = Hand.of(observation), observation["cube_pos"]
        away = hand.position - cube
        sideways = float(np.hypot(away[0], away[1]))
        width, stopped = self._gripper.opening(observation), self._gripper.has_stopped(observation)
        around = sideways < AROUND_M and abs(away[2]) < AROUND_M
        if around and stopped and self._held[0] < width < self._held[1]:
            target, gripper = np.array([cube[0], cube[1], CARRY_M]), self._gripper.hold
        elif around:
            target, gripper = cube, CLOSE
        else:
            target, gripper = above(cube, HOVER_M * funnel(sideways, *FUNNEL_M)), OPEN
        along = 0.0 if self._gripper.holds_edges else side_yaw(matrix_from_wxyz(observation["cube_quat"]))
        rotation = pointing_down(nearest_yaw(yaw_of(hand.rotation), along, QUARTER))
        action = towards(hand, target, rotation, gripper, speed=self._speed)
        return Decision(action, expert_action=action)
