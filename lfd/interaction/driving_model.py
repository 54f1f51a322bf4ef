"""Two cars as the planner has them: the bicycle in closed form over a horizon, R_H(theta) and R_goal, in torch.

The controls are u_R = (a_1, steering_1, ..., a_N, steering_N) and u_H = (a_1, ..., a_N), N steps of `STEP_S`. Then
both go on for `COAST` steps at a steady speed, straight ahead, so that a plan sees what it leads to. The Euler steps of
`lfd.worlds.driving_world` are cumulative sums, so that a horizon costs as many operations as a step. Seen from the
person, the robot is d ahead along their path and e beside it.

    R_H(theta) = - sum_k [ speed (v_H - cruise)^2 + effort a^2 + crash exp(-(d/5)^2 - (e/1.2)^2)
                           + near(e) (giving way exp(-(d/10)^2) + standing sigmoid(d/6)) ]
    R_goal     = - sum_k [ lane (y/3.5)^2 + speed (v_R - cruise)^2 + speeding max(v_R - cruise, 0)^2 + effort a^2
                           + steering steering^2 + yaw yaw^2 + danger exp(-(d/l_d)^2 - (e/l_e)^2) ]
                 - blocked exp(-(d_last/10)^2)

theta = (speed, effort, giving way, standing): who gives way keeps off what is in front of them, whoever stands their
ground minds that the robot is ahead; nobody wants to crash. near(e) = exp(-(e/2.5)^2) says how much of the robot is on
their path. The last term tells a horizon that is too short for a whole change of lanes that the lane is blocked as long
as they are alongside.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lfd.worlds.driving_world import LANE, WHEELBASE, Car, DrivingScene

STEP_S = 0.5
"""A step of the plan [s]."""
COAST = 3
"""Steps without controls after the plan's own."""
NEAR_M, AHEAD_M, STANDING_M = 2.5, 10.0, 6.0
CRASH, CRASH_M = 20.0, (5.0, 1.2)
"""Widths of R_H's features [m], and what a crash counts for everybody."""
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
    blocked: float = 8.0
    gap_m: float = 10.0
    """Length of what counts as alongside [m]."""


GOALS = {"merge": Goal(), "crossing": Goal(along_m=4.5, beside_m=4.5, blocked=0.0)}
"""Of each scene: cars at right angles are in each other's way by half a length and half a width, along and across."""


@dataclass(frozen=True)
class Situation:
    """Both cars now, on a scene."""

    scene: DrivingScene
    robot: Car
    person: Car

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

    def from_person(self, x: Tensor, y: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
        """d and e: where the robot is when the person has gone some way."""
        c, s = np.cos(self.person.yaw), np.sin(self.person.yaw)
        dx, dy = x - self.person.x, y - self.person.y
        return dx * c + dy * s - way, -dx * s + dy * c


def before(values: Tensor, first: float) -> Tensor:
    """Values at the beginning of each step, from those at its end."""
    return torch.cat([torch.full_like(values[..., :1], first), values[..., :-1]], dim=-1)


def person_reward(
    cruise: float, theta: Float[Tensor, "*p 4"], d: Tensor, e: Tensor, speed: Tensor, acceleration: Tensor
) -> Tensor:
    """R_H(theta), summed over the last axis of what it is given; theta's axes stand before that one."""
    speed_weight, effort, giving_way, standing = theta.unbind(-1)
    near = torch.exp(-((e / NEAR_M) ** 2))
    features = (
        (speed_weight, (speed - cruise) ** 2),
        (effort, acceleration**2),
        (giving_way, near * torch.exp(-((d / AHEAD_M) ** 2))),
        (standing, near * torch.sigmoid(d / STANDING_M)),
    )
    crash = torch.exp(-((d / CRASH_M[0]) ** 2) - (e / CRASH_M[1]) ** 2).sum(-1)
    return -CRASH * crash - sum(
        (weight * feature.sum(-1) for weight, feature in features), torch.zeros((), dtype=torch.float64)
    )


def goal_reward(
    goal: Goal,
    cruise: float,
    u_robot: Float[Tensor, "*s n"],
    path: tuple[Tensor, ...],
    d: Float[Tensor, "*s P N"],
    e: Float[Tensor, "*s 1 N"],
) -> Float[Tensor, "*s P"]:
    """R_goal for each way that the person may go."""
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
    danger = torch.exp(-((d / goal.along_m) ** 2) - (e / goal.beside_m) ** 2).sum(-1)
    blocked = torch.exp(-((d[..., -1] / goal.gap_m) ** 2))
    return -own[..., None] - goal.danger * danger - goal.blocked * blocked
