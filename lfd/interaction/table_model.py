"""The shared table as the planner has it: two points over a horizon, R_H(theta) and R_goal, in torch.

The gripper is a point p with u_R = (v_1, ..., v_N) in space, granted up to `GOAL_SPEED`; the hand is a point h with
velocities in its plane, laid out as all of x, then all of y; N steps of `STEP_S`. c is the centre of the gripper's
ball, d_h the distance of c and h. theta = (cube i, yielding):

    R_H(theta) = - sum_k [ reach |h - target| + effort |u_H|^2 / w_H^2 + yielding exp(-(d_h/0.22)^2)
                           + touch exp(-(d_h/0.09)^2) ]
    R_goal     = - sum_k [ effort |u_R|^2 / w_R^2 + danger exp(-(d_h/l)^2) + far S(p) ] - last far S(p_N)
    S(p)       = - tau log sum_j exp(-(|p - above cube j| + taken_j(theta)) / tau)

The target is cube i, and the person's own side as soon as they hold a cube. Whoever insists minds nothing but a touch;
who yields stays off the gripper. S is the soft least distance to a cube, where one that the person insists on counts as
`CLAIMED` m farther; a cube that was taken counts no more. |x| is sqrt(x^2 + 0.02^2), which is smooth.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from lfd.worlds.shared_table import ABOVE_M, HAND_HOME, REST_M, Table
from lfd.worlds.shared_table_guard import BALL_UP, GOAL_SPEED, HAND_HEIGHT, HAND_SPEED
from lfd.worlds.shared_table_model import OBJECTS

STEP_S = 0.4
"""A step of the plan [s]."""
REACH, EFFORT, TOUCH, YIELDING = 40.0, 0.5, 40.0, 50.0
"""Weights of R_H; yielding is that of people who do."""
KEEP_OFF_M, TOUCH_M = 0.22, 0.09
SMOOTH_M = 0.02
CLAIMED = 0.6
"""What a cube that the person insists on counts as, beside its distance [m]."""
MANNERS = {"insists": 0.0, "yields": YIELDING}
TYPES = {f"{name}-{manner}": (float(i), MANNERS[manner]) for i, name in enumerate(OBJECTS) for manner in MANNERS}
"""Theta by intent: the number of a cube, and yielding."""


@dataclass(frozen=True, kw_only=True)
class TableGoal:
    """Weights of R_goal."""

    far: float = 10.0
    last: float = 2.0
    """How many steps the end of the plan counts as."""
    effort: float = 0.1
    danger: float = 4.0
    danger_m: float = 0.22
    soft_m: float = 0.04
    """tau [m]."""


@dataclass(frozen=True)
class Reach:
    """Gripper, hand and cubes now."""

    gripper: Float[Tensor, "3"]
    hand: Float[Tensor, "2"]
    cubes: Float[Tensor, "3 2"]
    taken: int | None

    def robot_path(self, u_robot: Float[Tensor, "*s n"]) -> Float[Tensor, "*s N 3"]:
        """The gripper after each step [m]."""
        return self.gripper + STEP_S * limited(u_robot.unflatten(-1, (-1, 3))).cumsum(-2)

    def person_path(self, u_human: Float[Tensor, "*s 2 N"]) -> Float[Tensor, "*s N 2"]:
        """The hand after each step [m]."""
        return self.hand + STEP_S * u_human.cumsum(-1).transpose(-1, -2)

    def targets(self, theta: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Where people of each theta go [m]."""
        if self.taken is not None:
            return torch.tensor(HAND_HOME, dtype=torch.float64).expand(len(theta), 2)
        return self.cubes[theta[:, 0].long()]


def reach_now(table: Table) -> Reach:
    """The table as tensors. The gripper is taken to be where the controller's goal is, which plans move."""
    goal, hand, cubes = (torch.from_numpy(values).double() for values in (table.goal, table.hand, table.cubes))
    return Reach(goal, hand, cubes, table.taken)


def limited(velocity: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
    """The gripper's velocity as the world grants it, at most `GOAL_SPEED` [m/s]."""
    speed = torch.sqrt((velocity**2).sum(-1, keepdim=True) + 1e-12)
    return velocity * torch.clamp(GOAL_SPEED / speed, max=1.0)


def size(vectors: Float[Tensor, "*s d"]) -> Float[Tensor, "*s"]:
    """|x|, smooth at 0."""
    return torch.sqrt((vectors**2).sum(-1) + SMOOTH_M**2)


def apart_squared(gripper: Float[Tensor, "*s 3"], hand: Float[Tensor, "*s 2"]) -> Float[Tensor, "*s"]:
    """d_h^2 [m^2]."""
    up = gripper[..., 2] + BALL_UP - HAND_HEIGHT
    return ((gripper[..., :2] - hand) ** 2).sum(-1) + up**2


def person_reward(
    theta: Float[Tensor, "P 2"],
    targets: Float[Tensor, "P 2"],
    gripper: Float[Tensor, "*s #P N 3"],
    hand: Float[Tensor, "*s P N 2"],
    speed_squared: Float[Tensor, "*s P N"],
) -> Float[Tensor, "*s P"]:
    """R_H(theta), summed over the steps."""
    d2 = apart_squared(gripper, hand)
    cost = (
        REACH * size(hand - targets[:, None])
        + EFFORT * speed_squared / HAND_SPEED**2
        + theta[:, 1, None] * torch.exp(-d2 / KEEP_OFF_M**2)
        + TOUCH * torch.exp(-d2 / TOUCH_M**2)
    )
    return -cost.sum(-1)


def person_derivatives(
    theta: Float[Tensor, "P 2"],
    targets: Float[Tensor, "P 2"],
    gripper: Float[Tensor, "*s #P N 3"],
    hand: Float[Tensor, "*s P N 2"],
    u_human: Float[Tensor, "*s P 2 N"],
) -> tuple[Float[Tensor, "*s P"], Float[Tensor, "*s P M"], Float[Tensor, "*s P M M"]]:
    """R_H, dR_H/du_H and -d2R_H/du_H2 of each theta, in closed form, for the M = 2 N controls.

    With f(h_k) the cost of a step but for effort and h_k = h_0 + s (u_1 + ... + u_k), a control's slope is s times the
    sum of df/dh over the steps from its own on, and two controls' curvature is s^2 times that of d2f/dh2 from the later
    one on.
    """
    steps, eye = u_human.shape[-1], torch.eye(2, dtype=torch.float64)
    way, aside = hand - targets[:, None], hand - gripper[..., :2]
    length, d2 = size(way)[..., None], apart_squared(gripper, hand)
    speed_squared = (u_human**2).sum(-2)
    cost = REACH * length[..., 0] + EFFORT * speed_squared / HAND_SPEED**2
    slope = REACH * way / length
    curvature = (eye - (way / length)[..., None] * (way / length)[..., None, :]) * (REACH / length)[..., None]
    for weight, width in ((theta[:, 1, None], KEEP_OFF_M), (TOUCH, TOUCH_M)):
        near = weight * torch.exp(-d2 / width**2)
        bump = near[..., None] * (2.0 / width**2)
        cost, slope = cost + near, slope - bump * aside
        curvature = curvature + bump[..., None] * (
            (2.0 / width**2) * aside[..., None] * aside[..., None, :] - eye
        )  # fmt: skip
    own, both, effort = _onwards(steps)
    g = -(slope.transpose(-1, -2) @ own + 2.0 * EFFORT / HAND_SPEED**2 * u_human)
    pairs = curvature.flatten(-2).transpose(-1, -2) @ both  # (*s, P, 4, N N)
    blocks = pairs.unflatten(-1, (steps, steps)).unflatten(-3, (2, 2)).transpose(-3, -2).flatten(-2).flatten(-3, -2)
    return -cost.sum(-1), g.flatten(-2), blocks + effort


@lru_cache
def _onwards(steps: int) -> tuple[Float[Tensor, "N N"], Float[Tensor, "N NN"], Float[Tensor, "M M"]]:
    """What step k counts for control i, and for the pair i, j; and the curvature of effort."""
    own = torch.ones(steps, steps, dtype=torch.float64).tril()
    both = (own[:, :, None] * own[:, None, :]).flatten(1)
    return STEP_S * own, STEP_S**2 * both, 2.0 * EFFORT / HAND_SPEED**2 * torch.eye(2 * steps, dtype=torch.float64)


def goal_reward(
    goal: TableGoal,
    now: Reach,
    theta: Float[Tensor, "P 2"],
    u_robot: Float[Tensor, "*s n"],
    path: Float[Tensor, "*s N 3"],
    hand: Float[Tensor, "*s P N 2"],
) -> Float[Tensor, "*s P"]:
    """R_goal for each theta and the way that its person goes."""
    numbers = torch.arange(len(now.cubes))
    heights = torch.full((len(numbers), 1), REST_M + ABOVE_M, dtype=torch.float64)
    far = size(path[..., None, :] - torch.cat([now.cubes, heights], dim=-1))  # (*s, N, cubes)
    taken = torch.zeros(len(theta), len(numbers), dtype=torch.float64)
    if now.taken is None:
        insists = theta[:, 1] < 0.5 * YIELDING
        taken = CLAIMED * (insists[:, None] & (numbers == theta[:, 0, None])).double()
    else:
        taken[:, now.taken] = torch.inf
    least = -goal.soft_m * torch.logsumexp(-(far[..., None, :, :] + taken[:, None, :]) / goal.soft_m, dim=-1)
    danger = torch.exp(-apart_squared(path[..., None, :, :], hand) / goal.danger_m**2).sum(-1)
    effort = (u_robot**2).sum(-1)[..., None] / GOAL_SPEED**2
    return -goal.far * (least.sum(-1) + goal.last * least[..., -1]) - goal.danger * danger - goal.effort * effort
