"""Cars as the planner has them: the bicycle in closed form over a horizon, R_H(theta) and R_goal, in torch.

The controls are u_R = (a_1, steering_1, ..., a_N, steering_N) and u_H = (a_1, ..., a_N), N steps of `STEP_S`. Then
both go on for `COAST` steps at a steady speed, straight ahead, so that a plan sees what it leads to. The Euler steps of
`lfd.worlds.driving_world` are cumulative sums, so that a horizon costs as many operations as a step. Seen from the
person, the robot is d ahead along their path and e beside it.

    R_H(theta) = - sum_k [ speed (v_H - cruise)^2 + effort a^2 + crash exp(-(d/5)^2 - (1.5 e/w)^2)
                           + near(e) (giving way exp(-(d/10)^2) + standing sigmoid(d/6)) ]
    R_goal     = - sum_k [ lane (y/3.5)^2 + speed (v_R - cruise)^2 + speeding max(v_R - cruise, 0)^2 + effort a^2
                           + steering steering^2 + yaw yaw^2 + sum_cars danger exp(-(d/l_d)^2 - (e/l_e)^2) ]
                 - blocked [ exp(-(max(o, 0)/10)^2) + max(-o, 0)/10 ],      o = max(d_last, -d'_last)

theta = (speed, effort, giving way, standing): who gives way keeps off what is in front of them, whoever stands their
ground minds that the robot is ahead; nobody wants to crash. near(e) = exp(-(e/w)^2) says how much of the robot is on
their path, w is the scene's `in_the_way`: next to nothing of a car in the next lane. The last term tells a horizon that
is too short for a whole change of lanes that the lane is blocked as long as the robot is alongside, and where it ends
soonest: o is how far the robot is ahead of the first car or behind the last one, whose d is d', and negative between
them. A second car follows the person by its law, which is linear; that it would brake for the robot as well is not
counted on.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lfd.worlds.car_following import CarFollowing
from lfd.worlds.driving_world import LANE, LENGTH, WHEELBASE, Car, DrivingScene

STEP_S = 0.5
"""A step of the plan [s]."""
COAST = 3
"""Steps without controls after the plan's own."""
AHEAD_M, STANDING_M = 10.0, 6.0
CRASH, CRASH_M = 20.0, (5.0, 2.0 / 3.0)
"""Widths of R_H's features [m], and what a crash counts for everybody; its width beside the path is a part of w."""
PERSON_LOW, PERSON_HIGH = -4.0, 2.5
"""Limits of the person's acceleration [m/s^2]."""
TYPES = {
    "passive": (0.04, 0.25, 40.0, 0.0),
    "aggressive": (0.04, 0.25, 0.0, 40.0),
}
"""Theta by intent."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Weights of R_goal."""

    lane: float = 3.0
    speed: float = 0.03
    speeding: float = 1.0
    effort: float = 0.05
    steering: float = 150.0
    yaw: float = 10.0
    danger: float = 40.0
    along_m: float = 6.5
    """Length of the danger along the person's path [m]."""
    beside_m: float = 1.8
    """And across it [m]."""
    blocked: float = 20.0
    gap_m: float = 10.0
    """Length to which what is before the first car or behind the last one counts as alongside [m]."""


GOALS = {"merge": Goal(), "crossing": Goal(along_m=4.5, beside_m=4.5, blocked=0.0)}
"""Of each scene: cars at right angles are in each other's way by half a length and half a width, along and across."""


@dataclass(frozen=True)
class Situation:
    """The cars now, on a scene."""

    scene: DrivingScene
    robot: Car
    person: Car
    second: Car | None = None

    def robot_path(self, u_robot: Float[Tensor, "*n"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """x, y, yaw, speed after each step, each (..., N + COAST)."""
        acceleration, steering = pad(u_robot, (0, 2 * COAST)).unflatten(-1, (-1, 2)).unbind(-1)
        speed = self.robot.speed + STEP_S * acceleration.cumsum(-1)
        v = before(speed, self.robot.speed)
        yaw = self.robot.yaw + STEP_S * (v * torch.tan(steering) / WHEELBASE).cumsum(-1)
        heading = before(yaw, self.robot.yaw)
        x = self.robot.x + STEP_S * (v * torch.cos(heading)).cumsum(-1)
        y = self.robot.y + STEP_S * (v * torch.sin(heading)).cumsum(-1)
        return x, y, yaw, speed

    def person_path(self, u_human: Float[Tensor, "*n"]) -> tuple[Tensor, Tensor]:
        """Way along their path and speed after each step, each (..., N + COAST)."""
        speed = self.person.speed + STEP_S * pad(u_human, (0, COAST)).cumsum(-1)
        return STEP_S * before(speed, self.person.speed).cumsum(-1), speed

    def second_path(self, u_human: Float[Tensor, "*n"], *, follows: bool) -> Tensor:
        """Way of the second car after each step, (..., N + COAST), if it follows the person; else at its speed."""
        assert self.second is not None
        assert self.scene.second is not None
        steps = u_human.shape[-1]
        if not follows:
            return (STEP_S * self.second.speed * torch.arange(1, steps + COAST + 1, dtype=torch.float64)).expand(
                *u_human.shape[:-1], -1
            )
        gap = float(np.hypot(self.person.x - self.second.x, self.person.y - self.second.y)) - LENGTH
        at_rest, per_number = by_following(self.scene.second, steps)
        begun = torch.tensor([gap, self.second.speed, self.person.speed], dtype=torch.float64)
        return at_rest + begun @ per_number[:3] + u_human @ per_number[3:]

    def from_person(self, x: Tensor, y: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
        """d and e: where the robot is when the person has gone some way."""
        return seen_from(self.person, x, y, way)


def hardest_braking(speed: float, steps: int) -> Float[Tensor, "N"]:
    """Lowest accelerations of the person: as hard as they can until they stand. No controls above them drive backwards.

    Who brakes later than that is left out, for speeds from which they stand within the plan.
    """
    left = torch.clamp(speed + STEP_S * PERSON_LOW * torch.arange(steps, dtype=torch.float64), min=0.0)
    return torch.clamp(-left / STEP_S, min=PERSON_LOW)


def seen_from(car: Car, x: Tensor, y: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
    """How far ahead of a car, which has gone some way straight on, and to its left a point is."""
    c, s = float(np.cos(car.yaw)), float(np.sin(car.yaw))
    dx, dy = x - car.x, y - car.y
    return dx * c + dy * s - way, -dx * s + dy * c


def before(values: Tensor, first: float) -> Tensor:
    """Values at the beginning of each step, from those at its end."""
    return torch.cat([torch.full_like(values[..., :1], first), values[..., :-1]], dim=-1)


def person_reward(
    scene: DrivingScene, theta: Float[Tensor, "*p 4"], d: Tensor, e: Tensor, speed: Tensor, acceleration: Tensor
) -> Tensor:
    """R_H(theta), summed over the last axis of what it is given; theta's axes stand before that one."""
    speed_weight, effort, giving_way, standing = theta.unbind(-1)
    near = torch.exp(-((e / scene.in_the_way) ** 2))
    features = (
        (speed_weight, (speed - scene.cruise) ** 2),
        (effort, acceleration**2),
        (giving_way, near * torch.exp(-((d / AHEAD_M) ** 2))),
        (standing, near * torch.sigmoid(d / STANDING_M)),
    )
    crash = torch.exp(-((d / CRASH_M[0]) ** 2) - (e / (CRASH_M[1] * scene.in_the_way)) ** 2).sum(-1)
    return -CRASH * crash - sum(
        (weight * feature.sum(-1) for weight, feature in features), torch.zeros((), dtype=torch.float64)
    )


def person_derivatives[Array: (np.ndarray, Tensor)](
    exp: Callable[[Array], Array],
    per_control: tuple[Array, Array, Array],
    scene: DrivingScene,
    theta: Array,
    seen: tuple[Array, Array, Array, Array],
) -> tuple[Any, Any, Any]:
    """R_H of each type, the sum over the plan that `person_reward` is, dR_H/du_H and -d2R_H/du_H2, in numpy or torch.

    `per_control` is what `by_controls` found. theta is (P, 4), `seen` are d (*s, P, M), e (*s, 1, M), the speed
    (*s, P, M) and u_H (*s, P, N). Their way and speed are W u and V u and something constant, hence, for r the reward
    of a step,

        dR/du = V^T dr/dv - W^T dr/dd + dr/da,    -d2R/du2 = -V^T d2r/dv2 V - W^T diag(d2r/dd2) W - d2r/da2
    """
    (per_way, per_speed, one), (d, e, speed, u) = per_control, seen
    speed_weight, effort, giving_way, standing = (theta[:, k, None] for k in range(4))
    near = exp(-((e / scene.in_the_way) ** 2))
    crash = CRASH * exp(-((d / CRASH_M[0]) ** 2) - (e / (CRASH_M[1] * scene.in_the_way)) ** 2)
    giving = giving_way * near * exp(-((d / AHEAD_M) ** 2))
    share = 1.0 / (1.0 + exp(-d / STANDING_M))
    stand = standing * near * share
    value = -(crash + giving + stand + speed_weight * (speed - scene.cruise) ** 2).sum(-1) - (effort * u**2).sum(-1)
    stand = stand * (1.0 - share)
    slope = 2.0 * d * (crash / CRASH_M[0] ** 2 + giving / AHEAD_M**2) - stand / STANDING_M
    bend = (
        crash * (2.0 / CRASH_M[0] ** 2 - (2.0 * d / CRASH_M[0] ** 2) ** 2)
        + giving * (2.0 / AHEAD_M**2 - (2.0 * d / AHEAD_M**2) ** 2)
        - stand * (1.0 - 2.0 * share) / STANDING_M**2
    )
    g = -2.0 * speed_weight * ((speed - scene.cruise) @ per_speed) - slope @ per_way - 2.0 * effort * u
    own = 2.0 * speed_weight[..., None] * (per_speed.T @ per_speed) + 2.0 * effort[..., None] * one
    return value, g, own - per_way.T @ (bend[..., None] * per_way)


@cache
def by_controls(steps: int) -> tuple[Float[np.ndarray, "M N"], Float[np.ndarray, "M N"], Float[np.ndarray, "N N"]]:
    """W and V, what each control adds to the way and the speed after each of M = N + COAST steps, and the identity."""
    per_speed = STEP_S * np.concatenate([np.eye(steps), np.zeros((COAST, steps))]).cumsum(0)
    per_way = STEP_S * np.concatenate([np.zeros((1, steps)), per_speed[:-1]]).cumsum(0)
    return per_way, per_speed, np.eye(steps)


@cache
def by_following(law: CarFollowing, steps: int) -> tuple[Float[Tensor, "M"], Float[Tensor, "K M"]]:
    """The way of who follows by a law after each step, as an affine function of K = 3 + N numbers.

    They are the gap, their own speed, the speed of the one ahead, and the accelerations of that one.
    """
    numbers = np.concatenate([np.zeros((1, steps + 3)), np.eye(steps + 3)])
    gap, speed, ahead = numbers[:, :3].T
    way, ways = np.zeros(len(numbers)), []
    for acceleration in np.pad(numbers[:, 3:], ((0, 0), (0, COAST))).T:
        wish = law.wish(gap, speed, ahead)
        way, gap = way + STEP_S * speed, gap + STEP_S * (ahead - speed)
        speed, ahead = speed + STEP_S * wish, ahead + STEP_S * acceleration
        ways.append(way)
    found = torch.from_numpy(np.stack(ways, axis=-1))
    return found[0], found[1:] - found[0]


def goal_reward(
    goal: Goal,
    cruise: float,
    u_robot: Float[Tensor, "*s n"],
    path: tuple[Tensor, ...],
    cars: Sequence[tuple[Float[Tensor, "*s P N"], Float[Tensor, "*s 1 N"]]],
) -> Float[Tensor, "*s P"]:
    """R_goal for each way that the person may go; `cars` are d and e of each, the first
    one's first."""
    _, y, yaw, speed = path
    acceleration, steering = u_robot.unflatten(-1, (-1, 2)).unbind(-1)
    own = (
        goal.lane * ((y / LANE) ** 2).sum(-1)
        + goal.speed * ((speed - cruise) ** 2).sum(-1)
        + goal.speeding * (torch.relu(speed - cruise) ** 2).sum(-1)
        + goal.effort * (acceleration**2).sum(-1)
        + goal.steering * (steering**2).sum(-1)
        + goal.yaw * (yaw**2).sum(-1)
    )
    found = -own[..., None]
    for d, e in cars:
        danger = torch.exp(-((d / goal.along_m) ** 2) - (e / goal.beside_m) ** 2).sum(-1)
        found = found - goal.danger * danger
    outside = torch.maximum(cars[0][0][..., -1], -cars[-1][0][..., -1])
    beyond, inside = torch.relu(outside), torch.relu(-outside)
    return found - goal.blocked * (torch.exp(-((beyond / goal.gap_m) ** 2)) + inside / goal.gap_m)
