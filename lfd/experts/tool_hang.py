"""The scripted expert for ToolHang.

A state-feedback policy: which of its moves it makes is read from the present observation alone.

    hung       the tool's ring is on the hook             -> open, then back
    hang       the frame stands, the tool is held         -> the ring over the hook's post, down, and let the tool tip
    leave      the frame stands, the hand is still at it  -> open, then back
    fetch      the frame stands                           -> over the stand to the tool, open; close around its grip
    insert     the frame is held                          -> upright, its tip over the mount and down into it
    grasp      otherwise                                  -> down onto the frame's grip, open; close around it

The frame lies on the table with its rod level, so that the hand which grasps it from above points sideways when the
rod is upright: to the robot's right, where the arm has most room. The hook then points away from the robot.

The hook ends in a post, as high as the ring is wide: the ring passes only while it is tilted. It comes down over the
post with the tool nearly level and tilts on the way, down to `TILT_RAD[0]`, from where the tool swings into place by
itself when it is let go.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.core.rotations import matrix_from_wxyz, rotvec_between
from lfd.experts.grippers import gripper_of
from lfd.experts.reaching import CLOSE, OPEN, Hand, check_controller, funnel, towards
from lfd.experts.style import PLAIN, ExpertStyle

FRAME_GRIP = np.array([0.04375, 0.0, 0.0525])
"""Middle of the frame's grip, in the frame's axes [m]."""
GRIPS_M = (0.0, 0.012, -0.012)
"""Where along a grip it is held [m]."""
R_FRAME_HAND = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""The hand that holds the frame: its fingers point along the frame's y axis, the rod's tip along the hand's y axis."""
LEAN_RAD = 0.5
"""How far the hand that holds the tool leans towards the ring, so that it leans less when the tool tilts [rad]."""
R_TOOL_HAND = np.array(
    [
        [0.0, -np.cos(LEAN_RAD), np.sin(LEAN_RAD)],
        [-1.0, 0.0, 0.0],
        [0.0, -np.sin(LEAN_RAD), -np.cos(LEAN_RAD)],
    ]
)
"""The hand that holds the tool: but for the lean, the ring is along the hand's y axis, seen from the handle."""
MOUNT = np.array([0.0, 0.045, 0.080])
"""Top of the mount, in the stand's axes [m]."""
BOTTOM_M = 0.149
"""Depth of the mount [m]."""
HOVER_M = 0.08
"""Distance from a grip at which the hand is brought before it [m]."""
FUNNEL_M, TWIST_RAD = (0.008, 0.030), (0.15, 0.50)
"""Distance and angle beside a grip below which the hand goes all the way, and above which it hovers."""
ACROSS_M, AROUND_M, AROUND_RAD = 0.018, 0.010, 0.20
"""How far a grip may be from the middle of the fingers, along their way and across it, and the angle."""
HELD_M = 0.035
"""How far a grip may have slipped while it is held [m]."""
FRAME_WIDTH_M, TOOL_WIDTH_M = (0.018, 0.0285), (0.027, 0.0345)
"""Opening of the fingers when they hold the frame's grip, of 0.0254 m, and the tool's, of 0.030 m [m]."""
OPENED_M = (0.036, 0.055)
"""Opening of the fingers between which the hand begins to leave [m]."""
CLEAR_M = 0.03
"""Height above the mount at which the frame's tip is brought over it [m]."""
OVER_M, INSIDE_M = (0.0025, 0.012), 0.007
"""Distance of the tip from the mount's axis below which it goes down, above which it stays high, and below which a tip
lower than the top is inside [m]."""
UPRIGHT_RAD = (0.06, 0.25)
"""Angle of the frame from upright below which it goes down, and above which it stays high [rad]."""
SINK_M = 0.012
"""How far ahead the tip is sent down inside the mount [m]."""
STANDS_M = 0.012
"""Height of the tip above the mount's bottom below which the frame stands; robosuite asks for 0.017 [m]."""
BESIDE_M, BESIDE_HOOK_M = (0.08, 0.16), (0.16, 0.24)
"""Horizontal distance from the mount, and from the hook, below which what moves there has to be above it [m]."""
ROUND_STAND_M = (0.14, 0.20)
"""Distance from the frame in its stand up to which the open hand passes over it, and from which it need not [m]."""
OVER_STAND_M, DROP_M = 0.19, 0.5
"""Height above the mount's top at which it does so, and how much of it goes with the distance [m]."""
LEAVE_M = 0.10
"""How far the hand goes straight back from a grip that it let go [m]."""
AWAY_M = (0.25, 0.30)
"""Distance from the hook at which the hand comes to rest when all is done [m]."""
HIGH_M = 0.05
"""Height of the ring above the hook at which it is brought over it [m]."""
TILT_RAD = (0.72, 1.22)
"""Angle of the tool from hanging when the ring is around the bar, and above the post [rad]."""
LET_GO_RAD, PAST_POST_M, BAR_M = (0.9, 1.2), (0.003, 0.0095), 0.085
"""Angle below which the tool, let go with the ring around the bar, swings into place: from that where the ring is just
past the post's middle to that where it is past the post. And how far it may be along the bar [rad, m]."""
TILTING_M = (0.002, 0.014)
"""Height of the ring above the bar between which the tool tilts [m]."""
RING_M = (0.0060, 0.0045)
"""Distance of the ring's middle from the end of the bar when it is around it, and above the post [m]."""
POST_M = (0.0015, 0.006)
"""Distance of the ring from there, below which it goes down over the post, and above which it stays high [m]."""
THREADED_M = (0.006, 0.009)
"""The same for a ring as low as the post, between being around it and being beside it [m]."""
TURN_RAD = 0.25
"""How far the hand is asked to turn at a time [rad]; when it turns faster, the arm swings aside."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Pose:
    """Where a thing is in the world frame."""

    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Move:
    """Where the hand is to go, and what the gripper does."""

    position: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    gripper: float


class ToolHangExpert:
    """Puts the frame into the stand and hangs the tool on it with an OSC_POSE arm.

    Raises `InputError` for a world whose action is not OSC_POSE with a gripper.
    """

    name = "tool_hang_expert"

    def __init__(self, spec: WorldSpec, style: ExpertStyle = PLAIN):
        check_controller(spec, "ToolHang")
        self._style, self._gripper = style, gripper_of(spec)
        self._speed, self._along = style.speed[1], GRIPS_M[0]

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the speed of the episode, and where along their grips things are held."""
        self._speed = self._style.draw_speed(rng)
        self._along = GRIPS_M[self._style.draw_grasp(rng, len(GRIPS_M)) or 0]

    def act(self, observation: Observation) -> Decision:
        hand = Hand.of(observation)
        move = self._move(observation, hand)
        action = towards(hand, move.position, move.rotation, move.gripper, speed=self._speed)
        return Decision(action, expert_action=action)

    def _move(self, observation: Observation, hand: Hand) -> Move:
        frame, tool, stand = (
            Pose(observation[f"{name}_pos"], matrix_from_wxyz(observation[f"{name}_quat"]))
            for name in ("frame", "tool", "stand")
        )
        top = stand.position + stand.rotation @ MOUNT
        held_at = frame.position + frame.rotation @ (FRAME_GRIP + self._along * UP)
        frame_grip = Pose(held_at, frame.rotation @ R_FRAME_HAND)
        tip = observation["tip_point"]
        if not stands(tip - top):
            if self._holds(observation, hand, frame_grip, FRAME_WIDTH_M):
                return insert(hand, frame, tip, top)
            return grasp(hand, frame_grip)
        ring = Pose(observation["ring_point"], tool.rotation)
        tool_grip = Pose(tool.position + self._along * tool.rotation[:, 0], tool_hand(tool.rotation))
        placed = about_hook(ring, observation["hook_point"], frame)
        if placed.is_hung:
            return self._leave(observation, hand)
        if self._holds(observation, hand, tool_grip, TOOL_WIDTH_M):
            return hang(hand, ring, placed, frame)
        if is_at(hand, frame_grip):
            return self._leave(observation, hand)
        return over_stand(hand, grasp(hand, tool_grip), top, observation["hook_point"])

    def _holds(self, observation: Observation, hand: Hand, grip: Pose, width: tuple[float, float]) -> bool:
        opening = self._gripper.opening(observation)
        return float(np.linalg.norm(hand.position - grip.position)) < HELD_M and width[0] < opening < width[1]

    def _leave(self, observation: Observation, hand: Hand) -> Move:
        """Open, then straight back along the fingers, to some distance from the hook."""
        far = funnel(float(np.linalg.norm(hand.position - observation["hook_point"])), *AWAY_M)
        back = LEAVE_M * funnel(self._gripper.opening(observation), *OPENED_M) * (1.0 - far)
        return Move(hand.position - back * hand.rotation[:, 2], hand.rotation, OPEN)


def grasp(hand: Hand, grip: Pose) -> Move:
    """Towards a grip along the hand's axis, from before it; around it, close."""
    away = grip.rotation.T @ (hand.position - grip.position)
    twist = float(np.linalg.norm(rotvec_between(hand.rotation, grip.rotation)))
    off = max(funnel(float(np.hypot(away[0], away[1])), *FUNNEL_M), funnel(twist, *TWIST_RAD))
    around = abs(away[0]) < ACROSS_M and max(abs(away[1]), abs(away[2])) < AROUND_M and twist < AROUND_RAD
    position = grip.position - HOVER_M * off * grip.rotation[:, 2]
    return Move(position, slowly(hand.rotation, grip.rotation), CLOSE if around else OPEN)


def stands(tip: Float[np.ndarray, "3"]) -> bool:
    """Whether the frame stands in the mount, from its tip relative to the mount's top."""
    return float(np.hypot(tip[0], tip[1])) < INSIDE_M and float(tip[2]) < STANDS_M - BOTTOM_M


def insert(hand: Hand, frame: Pose, tip: Float[np.ndarray, "3"], top: Float[np.ndarray, "3"]) -> Move:
    """Bring the frame's tip over the mount with the frame upright, and down into it.

    The hand goes where it will be when the frame is upright, so that it turns there and not at arm's length from it.
    """
    ahead = np.array([0.0, -1.0, 0.0])
    goal = np.column_stack([np.cross(ahead, UP), ahead, UP])
    upright = hand.position - goal @ frame.rotation.T @ (hand.position - tip)  # where the tip will be
    aside, height = float(np.hypot(*(upright - top)[:2])), float(upright[2] - top[2])
    tip_aside = float(np.hypot(*(tip - top)[:2]))
    tilt = float(np.arccos(np.clip(frame.rotation[2, 2], -1.0, 1.0)))
    away = max(aside, tip_aside)
    off = max(funnel(away, *OVER_M), funnel(tilt, *UPRIGHT_RAD))
    if tip[2] < top[2] and tip_aside < INSIDE_M:
        off = 0.0
    free = max(funnel(height, CLEAR_M - 0.020, CLEAR_M - 0.010), funnel(aside, *BESIDE_M), 1.0 - off)
    goal_height = CLEAR_M * off if off > 0.0 else -BOTTOM_M - SINK_M
    down = max(goal_height - height, -SINK_M - 0.03 * off)
    step = np.array([*(free * (top - upright)[:2]), down])
    rotation = slowly(frame.rotation, goal) @ frame.rotation.T @ hand.rotation
    return Move(hand.position + step, rotation, CLOSE)


def placing(hand: Hand, held: Pose, goal: Pose) -> Move:
    """The move of the hand that brings what it holds to a pose, turning slowly: T_hand = T_goal T_held^-1 T_hand."""
    turned = slowly(held.rotation, goal.rotation) @ held.rotation.T
    return Move(goal.position + turned @ (hand.position - held.position), turned @ hand.rotation, CLOSE)


def slowly(rotation: Float[np.ndarray, "3 3"], goal: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation at most `TURN_RAD` on the way from one to another."""
    turn = rotvec_between(rotation, goal)
    angle = float(np.linalg.norm(turn))
    if angle <= TURN_RAD:
        return goal
    half = 0.5 * TURN_RAD
    return matrix_from_wxyz(np.array([np.cos(half), *(np.sin(half) / angle * turn)])) @ rotation


def tool_hand(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The hand that grasps the tool from above, whichever side of it is up."""
    upside = np.array([1.0, -1.0, -1.0]) if rotation[2, 2] < 0 else np.ones(3)
    return (rotation * upside) @ R_TOOL_HAND


def is_at(hand: Hand, grip: Pose) -> bool:
    """Whether the hand is still around a grip, or before it closer than it goes back."""
    away = grip.rotation.T @ (hand.position - grip.position)
    return float(np.hypot(away[0], away[1])) < 0.05 and -LEAVE_M < float(away[2]) < 0.03


def over_stand(hand: Hand, move: Move, top: Float[np.ndarray, "3"], hook: Float[np.ndarray, "3"]) -> Move:
    """The same move, but over the frame in its stand rather than through it: up first, then turned, then across."""
    beside = beside_segment(hand.position[:2], top[:2], hook[:2])
    way = move.position - hand.position
    away = float(np.hypot(way[0], way[1]))
    low = max(funnel(beside, *ROUND_STAND_M), 1.0 - funnel(away, *FUNNEL_M))
    lacking = float(top[2]) + OVER_STAND_M - DROP_M * low - float(hand.position[2])
    twist = float(np.linalg.norm(rotvec_between(hand.rotation, move.rotation)))
    near = 1.0 - funnel(beside, *ROUND_STAND_M)
    free = 1.0 - max(funnel(lacking, 0.005, 0.03), near * funnel(twist, 0.05, TURN_RAD - 0.05))
    step = np.array([free * way[0], free * way[1], max(float(way[2]), lacking)])
    return Move(hand.position + step, move.rotation, move.gripper)


def beside_segment(point: Float[np.ndarray, "2"], begin: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]) -> float:
    """Distance of a point from a line segment."""
    along = end - begin
    share = min(max(float((point - begin) @ along) / float(along @ along), 0.0), 1.0)
    return float(np.linalg.norm(point - begin - share * along))


@dataclass(frozen=True)
class AboutHook:
    """The ring as the hook sees it."""

    inward: float
    """From the end of the bar along it [m]."""
    aside: float
    """Beside the bar [m]."""
    height: float
    """Above the bar [m]."""
    tilt: float
    """Angle of the tool from hanging [rad]."""

    @property
    def is_hung(self) -> bool:
        """Whether the tool hangs, or would swing into place when it is let go."""
        around = abs(self.aside) < 0.006 and -0.012 < self.height < 0.0035
        share = 1.0 - funnel(self.inward, *PAST_POST_M)
        most = LET_GO_RAD[0] * share + LET_GO_RAD[1] * (1.0 - share)
        return around and PAST_POST_M[0] < self.inward < BAR_M and self.tilt < most


def about_hook(ring: Pose, hook: Float[np.ndarray, "3"], frame: Pose) -> AboutHook:
    """Where the ring is about the hook of a frame."""
    inward, aside, height = frame.rotation.T @ (ring.position - hook)
    handle = frame.rotation.T @ ring.rotation[:, 0]
    return AboutHook(float(inward), float(aside), float(height), float(np.arctan2(-handle[0], -handle[2])))


def hang(hand: Hand, ring: Pose, placed: AboutHook, frame: Pose) -> Move:
    """Bring the ring over the hook's post with the handle pointing away from the stand, and down around the bar."""
    high = funnel(placed.height, *TILTING_M)
    tilt, inward = (low + (up - low) * high for low, up in (TILT_RAD, RING_M))
    away = float(np.hypot(placed.inward - inward, placed.aside))
    handle = -np.sin(tilt) * frame.rotation[:, 0] - np.cos(tilt) * frame.rotation[:, 2]
    face = np.cos(tilt) * frame.rotation[:, 0] - np.sin(tilt) * frame.rotation[:, 2]
    face = face * np.copysign(1.0, face @ ring.rotation[:, 2])
    goal = np.column_stack([handle, np.cross(face, handle), face])
    twist = float(np.linalg.norm(rotvec_between(ring.rotation, goal)))
    threaded = (1.0 - funnel(away, *THREADED_M)) * (1.0 - high)
    off = max(funnel(away, *POST_M), funnel(twist, *TWIST_RAD)) * (1.0 - threaded)
    free = max(funnel(away, *BESIDE_HOOK_M), funnel(placed.height, HIGH_M - 0.025, HIGH_M - 0.010), 1.0 - off)
    wanted = np.array([inward, 0.0, HIGH_M * off])
    step = wanted - np.array([placed.inward, placed.aside, placed.height])
    step = np.array([free * step[0], free * step[1], max(step[2], -0.02)])
    return placing(hand, ring, Pose(ring.position + frame.rotation @ step, goal))
