"""The scripted expert for NutAssemblySquare.

A state-feedback policy: which of its four moves it makes is read from the present observation alone.

    leave      the nut is on the peg                   -> open, then up
    insert     the fingers have stopped on the handle  -> over the peg and down onto it
    grasp      the fingers are around the handle       -> close
    descend    otherwise                               -> down a funnel onto the handle, open

The nut is held by its handle and goes down over the peg in a funnel: the further its hole is beside the peg, or
turned against it, the higher it stays, so that one that has drifted off goes up again. The hand turns so that the
nut is level, also if it has tilted between the fingers.

Quarter turns are all the same to the square, but not to the arm. Where the hand holds the nut from the robot's side,
it turns to the yaw in which the arm rests. Where it holds the far side, a longer arm would be needed for that: it turns
half a turn further, in the direction in which the wrist has more room, and waits with the nut on the robot's side of
the peg until most of the turn is made.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.grippers import Gripper, gripper_of
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
    yaw_of,
)
from lfd.experts.style import PLAIN, ExpertStyle

HANDLE_M = 0.062
"""Distance of the grasp from the middle of the nut's hole, along the nut's x axis [m]."""
HOVER_M = 0.08
"""Height above the handle at which the gripper is brought over it [m]."""
FUNNEL_M = (0.010, 0.035)
"""Horizontal distance below which the gripper goes all the way down, and above which it hovers [m]."""
TWIST_RAD = (0.15, 0.60)
"""The same for the angle between the gripper and the handle, and between the nut and the peg [rad]."""
ACROSS_M, AROUND_M, AROUND_RAD = 0.018, 0.012, 0.25
"""How far the handle may be from the middle of the fingers, along their way and across it, and the angle."""
HELD_M = 0.015
"""How far the handle may have slipped while it is held [m]."""
HELD_WIDTH_M = (0.024, 0.040)
"""Opening of the fingers when they hold the handle, which is 0.032 m wide [m]."""
PEG_TOP_M = 0.10
"""Height of the peg's top above its middle [m]."""
PLAY_M = 0.006
"""How far the nut can be beside the peg's axis while it is around it; 0.007 along each side [m]."""
CLEAR_M, LOWEST_M, LET_GO_M = PEG_TOP_M + 0.025, 0.02, 0.04
"""Height of the nut above the peg's middle where it passes over the top, to which it is brought down, and below
which it is let go: it falls the rest of the way [m]."""
RIM_M = 0.05
"""From the middle of the nut to its rim: what a tilted nut needs more in height, for each unit of sine [m]."""
BESIDE_M = (0.11, 0.16)
"""Horizontal distance of the nut from the peg below which it has to be above the top before it moves on [m]."""
WAIT_M, WAIT_RAD = 0.15, (0.4, 1.2)
"""How far on the robot's side of the peg the nut stays while much of its turn is left, which the arm has no room for
beyond: at the far end of its reach it would not come back [m, rad]."""
ON_PEG_M = 0.02
"""Horizontal distance below which a nut lower than the peg's top is around it [m]; the play is 0.007 m."""
OPENED_M = (0.040, 0.060)
"""Opening of the fingers between which the gripper begins to leave [m]."""
HOME_YAW = np.pi / 2
"""Yaw of the hand in the arm's resting posture [rad]."""
WRIST_RAD = (0.26, 1.57)
"""The two grasps of a handle are half a turn apart; the one taken is nearest to a yaw in this range beyond
`HOME_YAW`, which keeps the wrist of a Panda off the limit that is nearer [rad]."""
LEAN_RAD = 0.5
"""How far beyond the present yaw the middle of the grasps is that count as near [rad]."""
TURN_RAD = 0.3
"""How far the hand is asked to turn at a time [rad]; when it turns faster, the arm swings aside."""


class NutAssemblySquareExpert:
    """Puts the square nut on its peg with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "nut_assembly_square_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "NutAssemblySquare")
        self._style, self._gripper = style, gripper_of(spec)
        self._speed, self._lean = style.speed[1], None

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode, and to which side of its range the wrist turns for the grasp."""
        self._speed = self._style.draw_speed(rng)
        side = self._style.draw_grasp(rng, 2)
        self._lean = None if side is None else WRIST_RAD[side]

    def act(self, observation: Observation) -> Decision:
        seen = _Seen.of(observation, self._lean)
        if seen.is_on_peg:
            target, rotation, gripper = self._leave(seen), pointing_down(seen.yaw), OPEN
        elif seen.is_held(self._gripper):
            target, rotation, gripper = self._insert(seen)
        else:
            off = max(funnel(seen.sideways, *FUNNEL_M), funnel(abs(seen.twist), *TWIST_RAD))
            target, gripper = above(seen.handle, HOVER_M * off), CLOSE if seen.is_around else OPEN
            rotation = pointing_down(seen.yaw + _slowly(seen.twist))
        action = towards(seen.hand, target, rotation, gripper, speed=self._speed)
        return Decision(action, expert_action=action)

    def _insert(self, seen: "_Seen") -> tuple[np.ndarray, np.ndarray, float]:
        """Move the hand by what the nut's hole lacks to the peg; sideways only where the nut is above the peg,
        well beside it or already around it."""
        yaw = HOME_YAW + (np.pi if seen.is_outside else 0.0)
        aside, height = float(np.hypot(*seen.to_peg[:2])), -float(seen.to_peg[2])
        play = PLAY_M * (2.0 - funnel(height, PEG_TOP_M - 0.01, PEG_TOP_M + 0.01))
        off = max(funnel(aside, play, play + PLAY_M), funnel(abs(yaw - seen.yaw), *TWIST_RAD))
        clear = CLEAR_M + RIM_M * float(np.hypot(*seen.nut[2, :2]))
        above_top = funnel(height, clear - 0.020, clear - 0.010)
        free = max(funnel(aside, *BESIDE_M), above_top, 1.0 - funnel(aside, 2 * PLAY_M, 4 * PLAY_M))
        wait = WAIT_M * funnel(abs(yaw - seen.yaw), *WAIT_RAD)
        move = np.array(
            [free * (seen.to_peg[0] - wait), free * seen.to_peg[1], LOWEST_M + (clear - LOWEST_M) * off - height]
        )
        rotation = turned(_slowly(yaw - seen.yaw)) @ levelling(seen.nut) @ seen.hand.rotation
        return seen.hand.position + move, rotation, self._gripper.hold

    def _leave(self, seen: "_Seen") -> np.ndarray:
        rising = funnel(self._gripper.opening(seen.observation), *OPENED_M)
        return seen.hand.position + rising * (above(seen.handle, 2 * HOVER_M) - seen.hand.position)


def levelling(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that brings a frame's z axis to the vertical, up or down, whichever is nearer.

    R = 1 + [v]_x + [v]_x^2 / (1 + c) with v = a x b and c = a . b brings the unit vector a to b.
    """
    x, y, z = rotation[:, 2] if rotation[2, 2] >= 0 else -rotation[:, 2]
    v = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + v + v @ v / (1.0 + z)


def turned(angle: float) -> Float[np.ndarray, "3 3"]:
    """The rotation by an angle about the vertical [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _slowly(turn: float) -> float:
    return min(max(turn, -TURN_RAD), TURN_RAD)


@dataclass(frozen=True)
class _Seen:
    """What the expert reads from an observation."""

    observation: Observation
    hand: Hand
    yaw: float
    """Of the hand [rad], within half a turn of HOME_YAW + pi / 4, the middle of the wrist's range."""
    handle: Float[np.ndarray, "3"]
    """The point at which the nut is grasped [m]."""
    grasp_yaw: float
    """Yaw of the hand for the grasp [rad]."""
    to_peg: Float[np.ndarray, "3"]
    """From the nut to the peg's middle [m]."""
    nut: Float[np.ndarray, "3 3"]
    """R_world_nut; its x axis points to the handle."""
    is_outside: bool
    """Whether the hand, turned to `HOME_YAW`, is beyond the nut as seen from the robot."""

    @classmethod
    def of(cls, observation: Observation, lean: float | None) -> "_Seen":
        """`lean` is the yaw beyond `HOME_YAW` to which the grasp is nearest; none means about the present one [rad]."""
        hand, nut = Hand.of(observation), matrix_from_wxyz(observation["SquareNut_quat"])
        yaw = nearest_yaw(HOME_YAW + np.pi / 4, yaw_of(hand.rotation), 2 * np.pi)
        lean = min(max(yaw - HOME_YAW + LEAN_RAD, WRIST_RAD[0]), WRIST_RAD[1]) if lean is None else lean
        return cls(
            observation=observation,
            hand=hand,
            yaw=yaw,
            handle=observation["SquareNut_pos"] + HANDLE_M * nut[:, 0],
            grasp_yaw=nearest_yaw(HOME_YAW + lean, yaw_of(nut) + np.pi / 2, np.pi),
            to_peg=observation["peg_pos"] - observation["SquareNut_pos"],
            nut=nut,
            is_outside=float(hand.rotation[:, 1] @ nut[:, 0]) > 0,
        )

    @property
    def sideways(self) -> float:
        away = self.hand.position - self.handle
        return float(np.hypot(away[0], away[1]))

    @property
    def twist(self) -> float:
        return self.grasp_yaw - self.yaw

    @property
    def is_around(self) -> bool:
        across, along, down = np.abs(self.hand.rotation.T @ (self.hand.position - self.handle))
        return bool(across < ACROSS_M and max(along, down) < AROUND_M and abs(self.twist) < AROUND_RAD)

    def is_held(self, gripper: Gripper) -> bool:
        away, width = float(np.linalg.norm(self.hand.position - self.handle)), gripper.opening(self.observation)
        stopped = gripper.has_stopped(self.observation)
        return away < HELD_M and stopped and HELD_WIDTH_M[0] < width < HELD_WIDTH_M[1]

    @property
    def is_on_peg(self) -> bool:
        return float(np.hypot(*self.to_peg[:2])) < ON_PEG_M and -float(self.to_peg[2]) < LET_GO_M
