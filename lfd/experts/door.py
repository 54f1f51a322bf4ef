"""The scripted expert for Door, whose latch must be turned before the door can be pulled open.

A state-feedback policy: which of its moves it makes is read from the present observation alone.

    open       the fingers are around the handle -> close; the more they have closed, along the handle's arc, and
                                                    the freer the latch is, along the door's
    approach   otherwise                         -> up beside the handle and down a funnel onto it, open

The hand takes the handle from above, one finger between handle and door, and turns it upwards: downwards an arm that
stands before the door would run into the ends of its wrist's joints. It leans into the door, because it is wider
than the handle is off the door. All this is done in the frame of the door's panel: x towards the hinge, y into the
door, z up.
"""

import numpy as np
from jaxtyping import Float

from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.reaching import CLOSE, OPEN, Hand, check_controller, funnel, towards
from lfd.experts.style import PLAIN, ExpertStyle

HINGE_M = 0.255
"""From the panel's centre to the hinge along x [m]."""
LATCH_M = np.array([-0.175, 0.0, -0.025])
"""From the panel's centre to the latch's axis, which is parallel to y [m]."""
HANDLE_M = -0.10
"""From the panel's centre to the handle's middle along y [m]."""
GRASPS_M = (0.130, 0.120, 0.110)
"""Distances from the latch's axis at which the hand may take the handle, which ends at 0.15; the first is plain [m]."""
DEEP_M = 0.005
"""How far beyond the handle's middle, along the fingers, the grip site is brought [m]."""
LEAN_RAD = 0.5
"""Angle between the fingers and straight down."""
TIP = 0.9
"""Angle by which the hand tips with the handle for each angle of the latch."""
HOVER_M = 0.08
"""How far off the handle, along the fingers, the hand is brought over it [m]."""
FUNNEL_M = (0.010, 0.030)
"""Distance beside the handle below which the hand goes all the way, and above which it hovers [m]."""
LOW_M = (0.010, 0.030)
"""Distance beyond its height in the funnel above which the hand waits a little, and altogether, until it is up [m]."""
LEANING_M = (0.080, 0.220)
"""Distance beside the handle below which the hand leans into the door, and above which it is upright [m]."""
AROUND_M = (0.015, 0.020, 0.015)
"""Distance across the handle, along it and along the fingers within which the fingers are around it [m]."""
HELD_WIDTH_M = (0.050, 0.054)
"""Opening of the fingers below which they hold the handle, 0.03 by 0.04, and above which they do not [m]."""
AHEAD_RAD, TURNED_RAD = 0.25, 1.3
"""By how much the latch's aim is ahead of its angle, and where it is to end up; it is free from 1.16 [rad]."""
FREE_RAD = (0.9, 1.2)
"""Angle of the latch above which the door is pulled a little, and with full strength [rad]."""
SWING_RAD, OPEN_RAD = 0.15, 0.37
"""By how much the door's aim is ahead of its angle, and where it is to end up: success asks for 0.3, the hinge ends at
0.4 [rad]."""


class DoorExpert:
    """Turns the handle and opens the door with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "door_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "Door")
        self._style, self._speed, self._radius = style, style.speed[1], GRASPS_M[0]

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode and where the handle is taken; beside them the expert has no memory."""
        self._speed = self._style.draw_speed(rng)
        self._radius = GRASPS_M[self._style.draw_grasp(rng, len(GRASPS_M)) or 0]

    def act(self, observation: Observation) -> Decision:
        hand = Hand.of(observation)
        centre, door = observation["Door_pos"], matrix_from_wxyz(observation["Door_quat"])
        swung, turned = (float(angle) for angle in observation["Door_qpos"])
        holding = _holding(TIP * turned, LEAN_RAD)
        deep = DEEP_M * holding[:, 2]
        handle = _on_handle(turned, self._radius) + deep
        away = holding.T @ (door.T @ (hand.position - centre) - handle)
        if (np.abs(away) < AROUND_M).all():
            held = 1.0 - funnel(float(np.ptp(observation["gripper_pos"])), *HELD_WIDTH_M)
            pull = held * funnel(-turned, *FREE_RAD)
            aim = _on_handle(turned - held * min(AHEAD_RAD, TURNED_RAD + turned), self._radius) + deep
            aim, gripper = _swung(aim, pull * min(SWING_RAD, OPEN_RAD - swung)), CLOSE
        else:
            beside = float(np.hypot(away[0], away[1]))
            off = funnel(beside, *FUNNEL_M)
            wait = off * funnel(away[2] + HOVER_M * off, *LOW_M)
            aim, gripper = handle + holding @ np.array([wait * away[0], wait * away[1], -HOVER_M * off]), OPEN
            holding = _holding(TIP * turned, LEAN_RAD * (1.0 - funnel(beside, *LEANING_M)))
        rotation = _nearer_way_round(hand, door @ holding)
        action = towards(hand, centre + door @ aim, rotation, gripper, speed=self._speed)
        return Decision(action, expert_action=action)


def _on_handle(turned: float, radius: float) -> Float[np.ndarray, "3"]:
    """The point of the handle at a distance from the latch's axis, in the door's frame [m]."""
    return LATCH_M + np.array([radius * np.cos(turned), HANDLE_M, -radius * np.sin(turned)])


def _swung(point: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3"]:
    """Where a point of the door will be when it has swung by an angle [rad], in the door's present frame [m]."""
    x, y, z = point[0] - HINGE_M, point[1], point[2]
    return np.array([HINGE_M + np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z])


def _holding(tipped: float, lean: float) -> Float[np.ndarray, "3 3"]:
    """R_door_hand of a hand that holds the handle: leaning into the door, tipped with the handle about y [rad].

    Its z axis points where the fingers do, and they open along its x axis.
    """
    c, s = np.cos(tipped), np.sin(tipped)
    tip = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    c, s = np.cos(lean), np.sin(lean)
    return tip @ np.array([[0.0, 1.0, 0.0], [c, 0.0, s], [s, 0.0, -c]])


def _nearer_way_round(hand: Hand, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation, or the one in which the fingers have changed places, whichever is nearer to the hand's."""
    return rotation if hand.rotation[:, 0] @ rotation[:, 0] > 0 else rotation * np.array([-1.0, -1.0, 1.0])
