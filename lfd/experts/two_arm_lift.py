"""The scripted expert for TwoArmLift: each arm takes one handle of the pot, and both lift it level.

A state-feedback policy: which of its moves each hand makes is read from the present observation alone.

    lift       both hands hold their handles     -> up, each to where its handle is when the pot is level
    wait       one hand holds its handle         -> down, until the pot stands on the table
    grasp      the fingers are around the handle -> close
    descend    otherwise                         -> down a funnel onto the handle, open

A handle is a frame of three bars. Hands take a bar that points away from the pot: it runs between a hand's fingers
about as the hands stand at the start, whereas the outer bar would need a quarter of a turn. The bars of the two hands
are opposite, so that the pot hangs below the line between them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.core.rotations import matrix_from_wxyz
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

GRASPS_M = (np.array([0.045, 0.125, 0.060]), np.array([-0.045, 0.125, 0.060]))
"""Where the hand at handle0 may take it, in the frame of the pot, whose handles are along y; the other hand takes the
opposite bar [m]."""
HALF_TURN, UPSIDE_DOWN = np.array([-1.0, -1.0, 1.0]), np.array([1.0, -1.0, -1.0])
"""Half turns about z and x, as factors of the axes."""
BASE_YAW = {"robot0_": np.pi / 2, "robot1_": -np.pi / 2, "right_": 0.0, "left_": 0.0}
"""Yaw of the frame in which an arm takes its action: two robots stand opposite each other [rad]."""
HOVER_M = 0.08
"""Height above the handle at which the hand is brought over it [m]."""
FUNNEL_M = (0.008, 0.030)
"""Horizontal distance below which the hand goes all the way down, and above which it hovers [m]."""
TURN_RAD = (0.15, 0.40)
"""The same for the angle between the fingers and the bar [rad]."""
AROUND_M = (0.018, 0.018, 0.022)
"""Distance along each axis of the world within which the fingers are around the bar [m]."""
HELD_WIDTH_M = (0.024, 0.030)
"""Opening of the fingers below which they hold the bar, 0.02 wide, and above which they do not [m]."""
REST_M, LIFTED_M = 0.870, 1.000
"""Height of the pot's centre on the table, and to which it is lifted; success asks for 0.97 [m]."""
UP_M, DOWN_M = 0.040, 0.020
"""By how much the aim is above the pot while both hands hold it, and below it while one does [m]."""


class TwoArmLiftExpert:
    """Lifts the pot with two OSC_POSE arms.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "two_arm_lift_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "TwoArmLift")
        self._style, self._speed, self._grasp = style, style.speed[1], GRASPS_M[0]
        self._places = {prefix: _place(spec, prefix) for prefix in BASE_YAW if f"{prefix}ee_pos" in spec.labels}
        self._size = len(spec.labels["action"])

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode and the pair of bars; beside them the expert has no memory."""
        self._speed = self._style.draw_speed(rng)
        self._grasp = GRASPS_M[self._style.draw_grasp(rng, len(GRASPS_M)) or 0]

    def act(self, observation: Observation) -> Decision:
        centre, pot = observation["pot_pos"], matrix_from_wxyz(observation["pot_quat"])
        widths = np.ptp(observation["gripper_pos"].reshape(len(self._places), -1), axis=1)
        bars = (self._grasp, HALF_TURN * self._grasp)
        reaches = {
            prefix: _Reach.of(Hand.of(observation, prefix), centre + pot @ bar, float(width))
            for prefix, bar, width in zip(self._places, bars, widths, strict=True)
        }
        both, height = min(reach.held for reach in reaches.values()), float(centre[2])
        rise = both * min(UP_M, LIFTED_M - height) - (1.0 - both) * min(DOWN_M, max(height - REST_M, 0.0))
        yaw = yaw_of(pot)
        upright = pointing_down(yaw) * UPSIDE_DOWN - pot
        action = np.empty(self._size)
        for (prefix, reach), bar in zip(reaches.items(), bars, strict=True):
            move = self._arm(reach, above(upright @ bar, rise), yaw)
            action[self._places[prefix]] = _in_base(move, BASE_YAW[prefix])
        return Decision(action, expert_action=action)

    def _arm(self, reach: "_Reach", way: Float[np.ndarray, "3"], yaw: float) -> Float[np.ndarray, "7"]:
        """One arm's action in the world frame; `way` is how its bar is to move [m], `yaw` that of the bar [rad]."""
        hand, hand_yaw = reach.hand, yaw_of(reach.hand.rotation)
        turned = nearest_yaw(hand_yaw, yaw, np.pi)
        if reach.around:  # the more it holds the bar, the less does it matter where the hand holds it
            aim, gripper = reach.bar + reach.held * (hand.position - reach.bar) + way, CLOSE
        else:
            sideways = float(np.hypot(*(hand.position - reach.bar)[:2]))
            off = max(funnel(sideways, *FUNNEL_M), funnel(abs(turned - hand_yaw), *TURN_RAD))
            aim, gripper = above(reach.bar, HOVER_M * off), OPEN
        return towards(hand, aim, pointing_down(turned), gripper, speed=self._speed)


@dataclass(frozen=True)
class _Reach:
    """A hand and its bar."""

    hand: Hand
    bar: Float[np.ndarray, "3"]
    """Where to take the bar, in the world frame [m]."""
    around: bool
    """Whether the fingers are around it."""
    held: float
    """How much they hold it, 0 to 1."""

    @classmethod
    def of(cls, hand: Hand, bar: Float[np.ndarray, "3"], width: float) -> "_Reach":
        """From where both are, and the opening of the fingers [m]."""
        around = bool((np.abs(hand.position - bar) < AROUND_M).all())
        return cls(hand, bar, around, around * (1.0 - funnel(width, *HELD_WIDTH_M)))


def _place(spec: WorldSpec, prefix: str) -> Int[np.ndarray, "7"]:
    """Where an arm's components are in the action."""
    names = spec.labels["action"]
    return np.array([names.index(f"{prefix}{name}") for name in ("x", "y", "z", "rx", "ry", "rz", "gripper")])


def _in_base(action: Float[np.ndarray, "7"], yaw: float) -> Float[np.ndarray, "7"]:
    """An arm's action in the world frame, in that of its base."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z, rx, ry, rz, gripper = action
    return np.array([c * x + s * y, c * y - s * x, z, c * rx + s * ry, c * ry - s * rx, rz, gripper])
