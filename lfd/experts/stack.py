"""The scripted expert for Stack: cube A, of 0.04 m, on cube B, of 0.05 m.

A state-feedback policy: which of its moves it makes is read from the present observation alone.

    release    A stands on B, or just above it       -> open, and straight up once the fingers are off it
    carry      the fingers have stopped on A         -> up, over B, and down a funnel onto it
    grasp      the fingers are around A              -> close
    descend    otherwise                             -> down a funnel onto A, open

As in Lift the fingers of a wide gripper close along the axes of the world, whatever the cube's yaw is. Where B stands
in their way, they turn aside just as far as they must. A narrow gripper takes A by those two of its sides that B leaves
free, the ones which ask for the smaller turn if both pairs are.
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
    side_yaw,
    towards,
    yaw_of,
)
from lfd.experts.style import PLAIN, ExpertStyle

STACKED_M = 0.045
"""Height of A's centre above B's when A stands on B [m]."""
RADIUS_B_M = 0.035
"""From B's axis to its edges [m]."""
HOVER_M = 0.06
"""Height above A at which the gripper is brought over it [m]."""
FUNNEL_M = (0.008, 0.030)
"""Horizontal distance below which the gripper goes all the way down, and above which it hovers [m]."""
AROUND_M = 0.015
"""Distance at which the fingers are around A [m]."""
HELD_WIDTH_M = {True: (0.030, 0.062), False: (0.030, 0.048)}
"""Opening of the fingers when they hold A: 0.040 m by its sides to 0.057 m by its edges, where they hold these [m]."""
CLEAR_M = 0.04
"""Air between A and the top of B while A is brought over it [m]."""
PRESS_M = 0.004
"""How much lower than B's top A is pushed, so that it gets there [m]."""
OVER_M = (0.010, 0.035)
"""Horizontal distance of A from B below which it is lowered all the way, and above which it is carried high [m]."""
RISE_M = (0.005, 0.020)
"""How much lower than wanted A may be while it moves freely sideways, and where it only rises [m]."""
ALIGNED_M = 0.018
"""Horizontal distance within which A stands on B; it would tip over at 0.025 [m]."""
DROP_M = 0.008
"""Height above B from which A is let go [m]."""
FREE_M = {True: (0.062, 0.074), False: (0.046, 0.056)}
"""Opening of the fingers at which they begin to be off A, and at which they are, whether they hold edges or not [m]."""
AWAY_M = 0.08
"""How far the goal of the retreat is above the hand [m]."""
BESIDE_M = (0.0, 0.03)
"""Height of A's centre above B's up to which B is in the fingers' way, and from which it is not [m]."""
MARGIN_M = 0.003
"""Between an open finger and B [m]."""
ASIDE_M = (-0.010, 0.020)
"""Distance of B from the outside of the fingers along their line up to which they turn all the way, and from which
not at all [m]."""
GRASPS = (np.pi / 2, np.pi / 4, 3 * np.pi / 4)
"""Angles of the line along which the fingers close [rad]: that of the start, and an eighth of a turn off."""


class StackExpert:
    """Stacks cube A on cube B with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "stack_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "Stack")
        self._style, self._gripper = style, gripper_of(spec)
        self._held, self._free = (by_edges[self._gripper.holds_edges] for by_edges in (HELD_WIDTH_M, FREE_M))
        self._speed, self._grasp = style.speed[1], GRASPS[0]

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode and the line along which the fingers close; it has no other memory."""
        self._speed = self._style.draw_speed(rng)
        self._grasp = GRASPS[self._style.draw_grasp(rng, len(GRASPS)) or 0]

    def act(self, observation: Observation) -> Decision:
        hand, a, b = Hand.of(observation), observation["cubeA_pos"], observation["cubeB_pos"]
        away, top = hand.position - a, above(b, STACKED_M)
        sideways, off = float(np.hypot(away[0], away[1])), float(np.hypot(a[0] - b[0], a[1] - b[1]))
        width, stopped = self._gripper.opening(observation), self._gripper.has_stopped(observation)
        around = sideways < AROUND_M and abs(away[2]) < AROUND_M
        if abs(a[2] - top[2]) < DROP_M and off < ALIGNED_M:
            target, gripper = above(hand.position, AWAY_M * funnel(width, *self._free)), OPEN
        elif around and stopped and self._held[0] < width < self._held[1]:
            target, gripper = hand.position + _carried(a, top, off) - a, self._gripper.hold
        elif around:
            target, gripper = a, CLOSE
        else:
            target, gripper = above(a, HOVER_M * funnel(sideways, *FUNNEL_M)), OPEN
        rotation = pointing_down(self._yaw(hand, a, b, observation["cubeA_quat"]))
        action = towards(hand, target, rotation, gripper, speed=self._speed)
        return Decision(action, expert_action=action)

    def _yaw(
        self, hand: Hand, a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"], quat_a: Float[np.ndarray, "4"]
    ) -> float:
        """Angle of the line along which the fingers close [rad]."""
        needed, way = self._room(a, b)
        if self._gripper.holds_edges:
            phi = _between(self._grasp, way)
            return float(self._grasp + np.copysign(max(needed - abs(phi), 0.0), phi))
        if a[2] > b[2] + BESIDE_M[1]:  # A may turn between the fingers: the hand does not follow it
            return yaw_of(hand.rotation)
        near = nearest_yaw(yaw_of(hand.rotation), side_yaw(matrix_from_wxyz(quat_a)), np.pi / 2)
        far = near + np.copysign(np.pi / 2, self._grasp - near)
        return near if abs(_between(near, way)) >= min(needed, abs(_between(far, way))) else far

    def _room(self, a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Angle that must be between the fingers' line and the way from A to B, and the angle of that way [rad].

        A finger of breadth 2 w passes B, seen as a disc of radius r at distance d from A, when the angle phi between
        the line and the way has d sin(phi) >= w + r.
        """
        way = b[:2] - a[:2]
        distance = float(np.hypot(way[0], way[1]))
        reach = self._gripper.reach_m + RADIUS_B_M
        ratio = (self._gripper.breadth_m + RADIUS_B_M + MARGIN_M) / max(distance, RADIUS_B_M)
        needed = float(np.arcsin(min(ratio, 1.0))) * (1.0 - funnel(distance, reach + ASIDE_M[0], reach + ASIDE_M[1]))
        return needed * (1.0 - funnel(a[2] - b[2], *BESIDE_M)), float(np.arctan2(way[1], way[0]))


def _between(line: float, way: float) -> float:
    """Signed angle from a direction to a line, the smaller of the two [rad]."""
    return (line - way + np.pi / 2) % np.pi - np.pi / 2


def _carried(a: Float[np.ndarray, "3"], top: Float[np.ndarray, "3"], off: float) -> Float[np.ndarray, "3"]:
    """Where A, which is held, should go on its way to `top`: up first, then over B, then down."""
    height = top[2] + CLEAR_M * funnel(off, *OVER_M)
    sideways = 1.0 - funnel(height - a[2], *RISE_M)
    return np.array([*(a[:2] + sideways * (top[:2] - a[:2])), height - PRESS_M])
