"""The scripted expert for PickPlaceCan.

A state-feedback policy: which of its moves it makes is read from the present observation alone.

    release    the can is in its compartment, low    -> open, and straight up once the fingers are off it
    carry      the fingers have stopped on the can   -> up, over the walls, and down a funnel into the compartment
    grasp      the fingers are around the can        -> close
    descend    otherwise                             -> down a funnel onto the can, open

The can is round: the gripper keeps to the axes of the world, whatever the can's yaw is. It turns only where it has
to: by the walls, along them; and across a can that has fallen over.

Over the far bin a Panda's arm is nearly stretched. When the can is put back into the first bin at that moment, the
elbow may come to its limit on the way there, which OSC does not leave again.
"""

import numpy as np
from jaxtyping import Float

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
    towards,
)
from lfd.experts.style import PLAIN, ExpertStyle

INSIDE_LOW, INSIDE_HIGH = np.array([0.13, 0.31]), np.array([0.27, 0.50])
"""Where the can is in its compartment [m]: 0.03 m within the bounds of robosuite, the same in every episode."""
DROP = np.array([0.155, 0.345])
"""Where the can is let go [m]: nearer than the compartment's centre, where a Panda's elbow comes to its limit."""
BIN_CENTRE, BIN_HALF = np.array([0.10, -0.25]), np.array([0.19, 0.24])
"""The bin that the can starts in, between its walls [m]."""
DOWN_M = (0.88, 0.93)
"""Height of the can below which the walls of the bin matter to the fingers, and above which they do not [m]."""
BY_WALL_M = (0.055, 0.068)
"""Distance of the can's axis from a wall at which the fingers run along it, and from which they need not [m]."""
GRIP_M = 0.010
"""Height of the grip above the can's centre [m]; the hand is then above the walls."""
GRASPS = (np.pi / 2, np.pi / 4, 3 * np.pi / 4)
"""Angles of the line along which the fingers close [rad]: that of the start, and an eighth of a turn off."""
TURN_SIDE = 0.1
"""By a wall of the bin the hand turns by a quarter towards this side [rad]; on the other the wrist meets its limit."""
HOVER_M = 0.08
"""Height above the grip at which the gripper is brought over it [m]."""
FUNNEL_M = (0.010, 0.040)
"""Horizontal distance below which the gripper goes all the way down, and above which it hovers [m]."""
AROUND_M = 0.015
"""Distance at which the fingers are around the can [m]."""
SLIPPED_M = 0.030
"""Distance within which a closed gripper has hold of the can, which may have slipped [m]."""
HELD_WIDTH_M = (0.035, 0.060)
"""Opening of the fingers when they hold the can of 0.050 m [m]."""
CARRY_M = 0.98
"""Height of the can's centre when it is carried over the walls, 0.04 m of air below it [m]."""
LOWERED_M = 0.90
"""Height of the can's centre at the end of the way into the compartment, where it stands at 0.86 [m]."""
LET_GO_M = 0.91
"""Height of the can's centre below which it is let go [m]."""
OVER_M = (0.02, 0.10)
"""Horizontal distance from `DROP` below which the can is lowered all the way, and from which it is high [m]."""
RISE_M = (0.01, 0.05)
"""How much lower than wanted hand or can may be while they move freely sideways, and where they only rise [m]."""
FREE_M = (0.056, 0.068)
"""Opening of the fingers at which they begin to be off the can, and at which they are [m]."""
AWAY_M = 0.10
"""How far the goal of the retreat is above the hand [m]."""
TILTED = (0.3, 0.7)
"""Sine of the can's tilt from which the fingers begin to turn across it, and at which they have [1]."""


class PickPlaceCanExpert:
    """Puts the can into its compartment with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "pick_place_can_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "PickPlaceCan")
        self._style, self._gripper = style, gripper_of(spec)
        self._speed, self._grasp = style.speed[1], GRASPS[0]

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode and the line along which the fingers close; it has no other memory."""
        self._speed = self._style.draw_speed(rng)
        self._grasp = GRASPS[self._style.draw_grasp(rng, len(GRASPS)) or 0]

    def act(self, observation: Observation) -> Decision:
        hand, can = Hand.of(observation), observation["Can_pos"]
        grip = above(can, GRIP_M)
        away = hand.position - grip
        sideways = float(np.hypot(away[0], away[1]))
        width = self._gripper.opening(observation)
        closed_on_it = HELD_WIDTH_M[0] < width < HELD_WIDTH_M[1] and self._gripper.has_stopped(observation)
        if can[2] < LET_GO_M and (can[:2] > INSIDE_LOW).all() and (can[:2] < INSIDE_HIGH).all():
            target, gripper = above(hand.position, AWAY_M * funnel(width, *FREE_M)), OPEN
        elif closed_on_it and np.linalg.norm(away) < SLIPPED_M:
            target, gripper = hand.position + _carried(can) - can, self._gripper.hold
        elif sideways < AROUND_M and abs(away[2]) < AROUND_M:
            target, gripper = grip, CLOSE
        else:
            height = grip[2] + HOVER_M * funnel(sideways, *FUNNEL_M)
            target, gripper = _over_walls(hand.position, grip[:2], height), OPEN
        rotation = pointing_down(self._yaw(can, observation["Can_quat"]))
        action = towards(hand, target, rotation, gripper, speed=self._speed)
        return Decision(action, expert_action=action)

    def _yaw(self, can: Float[np.ndarray, "3"], quat: Float[np.ndarray, "4"]) -> float:
        """Angle of the line along which the fingers close [rad]."""
        room = BIN_HALF - np.abs(can[:2] - BIN_CENTRE)
        low = 1.0 - funnel(float(can[2]), *DOWN_M) if (room > 0.0).all() else 0.0
        by_wall = low * (1.0 - funnel(float(room.min()), *BY_WALL_M))
        yaw = self._grasp
        if by_wall > 0.0:
            into_corner = np.sign(np.prod(can[:2] - BIN_CENTRE))
            along = -into_corner * np.arctan2(room[1], room[0])  # as far to each side as there is room
            yaw += by_wall * (nearest_yaw(yaw + TURN_SIDE, float(along), np.pi) - yaw)
        axis = matrix_from_wxyz(quat)[:2, 2]
        lying = funnel(float(np.hypot(axis[0], axis[1])), *TILTED)
        across = nearest_yaw(yaw, float(np.arctan2(axis[1], axis[0])) + np.pi / 2, np.pi)
        return float(yaw + lying * (across - yaw))


def _carried(can: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where a can that is held should go: up first, then over the walls, then down."""
    off = float(np.hypot(DROP[0] - can[0], DROP[1] - can[1]))
    return _over_walls(can, DROP, LOWERED_M + (CARRY_M - LOWERED_M) * funnel(off, *OVER_M))


def _over_walls(start: Float[np.ndarray, "3"], goal: Float[np.ndarray, "2"], height: float) -> Float[np.ndarray, "3"]:
    """The next point on the way from `start` to `goal` at a height: sideways only where that is nearly reached."""
    sideways = 1.0 - funnel(height - start[2], *RISE_M)
    return np.array([*(start[:2] + sideways * (goal - start[:2])), height])
