"""Keeps an arm's gripper off a hand, whatever the hand does: an inequality that can be kept from now on.

The gripper is within a ball around q = p + `BALL_UP` z, p the goal that the arm's controller holds, and the hand within
one around h. With E the most by which the arm is off its goal, their surfaces are `LEAST_DISTANCE` apart if

    |q - h| >= R,        R = LEAST_DISTANCE + GRIPPER_RADIUS + HAND_RADIUS + E

The hand stays at its height z_H and is at most w_H fast, the goal is at most w_R fast. A retreat along n goes straight,
at w_R, until the hand is too low to matter, q_z >= z_H + R + w_H dt, and stays there. It keeps the distance if

    m(q, h, n) = min_{0 <= t <= T} |q + w_R t n - h| - w_H t >= R                                              (1)

The state is safe if (1) holds for one of `RETREATS`, whose end is within `GOAL_LOW` and `GOAL_HIGH`. In a step of dt
the hand goes nowhere that is more than w_H dt from h, so that a goal p' may be taken if

    m(q', h, n) - w_H dt >= R        for some n                                                                (2)

Then (1) holds wherever the hand h' is after the step, and the retreat's first step is a goal that satisfies (2) again:
with |h' - h| <= w_H dt, (2) gives |q' + w_R (t + dt) n - h'| - w_H t - w_H dt >= R for all t. So from a safe start
there is always a goal that may be taken (compare the backup controllers of Gurriet et al. 2020, and the separation
monitoring of ISO/TS 15066).

E: robosuite's OSC_POSITION gives x'' = w^2 (p - x) - 2 w x', w = sqrt(k_p), critically damped, for which p - x is p'
convolved with exp(-w t) (1 + w t), whose integral is 2/w; goals are held for dt, and lead by as much as w_R dt. Hence

    |p - x| <= w_R (2/w + dt)                                                                                  (3)

The arm has friction, and its controller takes translation and rotation for independent, which they are not: E is
`ALLOWED` times (3), more than is met with goals that turn back and forth at the worst rate. (2) is proven for arms
within E; the world measures that this one is, and breaks off where it is not.
"""

import numpy as np
from jaxtyping import Bool, Float

TICK_S = 0.05
"""dt, between goals of the controller [s]."""
LEAST_DISTANCE = 0.05
"""Between the surfaces of arm and hand [m]."""
GOAL_SPEED, HAND_SPEED = 0.2, 0.13
"""w_R and w_H [m/s]."""
STIFFNESS = 150.0
"""k_p of robosuite's OSC_POSITION [1/s^2]."""
ALLOWED = 1.5
"""E as a multiple of (3)."""
TRACKING = ALLOWED * GOAL_SPEED * (2.0 / np.sqrt(STIFFNESS) + TICK_S)
"""E [m]."""
BALL_UP, GRIPPER_RADIUS = 0.075, 0.12
"""Centre, above the grip site, and radius of the ball that the gripper is in [m]."""
HAND_RADIUS, HAND_HEIGHT = 0.05, 0.89
"""Of the ball that the hand is in, and z_H of its centre in the world [m]."""
SEPARATION = LEAST_DISTANCE + GRIPPER_RADIUS + HAND_RADIUS + TRACKING
"""R [m]."""
SAFE_HEIGHT = HAND_HEIGHT + SEPARATION + HAND_SPEED * TICK_S
"""Of the ball's centre, above which the hand does not matter [m]."""
GOAL_LOW, GOAL_HIGH = np.array([-0.2, -0.42, 0.87]), np.array([0.08, 0.42, 1.12])
"""Where goals may be, in the world [m]."""
SLOWER = (1.0, 0.6, 0.3)
"""Parts of the wanted velocity that are tried."""


def _retreats() -> Float[np.ndarray, "R 3"]:
    """Unit vectors: straight up, and at three elevations in sixteen directions each."""
    around = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    rows = [[0.0, 0.0, 1.0]]
    for up in np.radians([25.0, 45.0, 65.0]):
        rows += [[np.cos(up) * np.cos(a), np.cos(up) * np.sin(a), np.sin(up)] for a in around]
    return np.array(rows)


RETREATS = _retreats()
"""n."""


def margins(goal: Float[np.ndarray, "3"], hand: Float[np.ndarray, "2"]) -> Float[np.ndarray, "R"]:
    """m(q, h, n) of each retreat [m]; -inf where it would leave the goals' limits.

    |q + w_R t n - h| - w_H t is convex in t: its minimum is where the slope vanishes, or at an end of [0, T].
    """
    away = np.append(goal[:2] - hand, goal[2] + BALL_UP - HAND_HEIGHT)
    longest = max(SAFE_HEIGHT - goal[2] - BALL_UP, 0.0) / (GOAL_SPEED * RETREATS[:, 2])
    along = RETREATS @ away
    beside = np.sqrt(np.maximum(away @ away - along**2, 0.0))
    slowest = HAND_SPEED * beside / np.sqrt(GOAL_SPEED**2 - HAND_SPEED**2)
    t = np.clip((slowest - along) / GOAL_SPEED, 0.0, longest)
    least = np.hypot(along + GOAL_SPEED * t, beside) - HAND_SPEED * t
    ends = goal + (GOAL_SPEED * longest)[:, None] * RETREATS
    return np.where(_within(ends), least, -np.inf)


def is_allowed(goal: Float[np.ndarray, "3"], hand: Float[np.ndarray, "2"]) -> bool:
    """(2): whether a goal may be taken while the hand is where it is."""
    return bool(margins(goal, hand).max() - HAND_SPEED * TICK_S >= SEPARATION)


def guarded(
    goal: Float[np.ndarray, "3"], hand: Float[np.ndarray, "2"], wanted: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """The goal after dt: as near to the wanted velocity [m/s] as (2) allows.

    Slower, then past the hand or over it, then standing still; where not even that is allowed, the best retreat.
    """
    speed = float(np.linalg.norm(wanted))
    wanted = wanted * min(1.0, GOAL_SPEED / max(speed, 1e-12))
    towards = np.append(hand - goal[:2], HAND_HEIGHT - goal[2] - BALL_UP)
    towards /= max(float(np.linalg.norm(towards)), 1e-12)
    past = wanted - max(float(wanted @ towards), 0.0) * towards
    for velocity in (*(part * wanted for part in SLOWER), *(part * past for part in SLOWER), np.zeros(3)):
        tried = np.clip(goal + TICK_S * velocity, GOAL_LOW, GOAL_HIGH)
        if is_allowed(tried, hand):
            return tried
    best = RETREATS[int(margins(goal, hand).argmax())]
    left = max(SAFE_HEIGHT - goal[2] - BALL_UP, 0.0) / best[2]
    return np.clip(goal + min(GOAL_SPEED * TICK_S, left) * best, GOAL_LOW, GOAL_HIGH)


def _within(ends: Float[np.ndarray, "R 3"]) -> Bool[np.ndarray, "R"]:
    """Which points are within the goals' limits, but for rounding."""
    return np.all((ends >= GOAL_LOW - 1e-9) & (ends <= GOAL_HIGH + 1e-9), axis=1)
