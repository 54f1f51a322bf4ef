"""The robot leads, the person follows: u_R* = argmax R_R(u_R, u_H*(u_R)) (chapter 10.6.1, Eq. 10.8 and 10.9).

    dJ/du_R = dR_R/du_R - dR_R/du_H* (dg/du_H*)^-1 dg/du_R,        g = dR_H/du_H

The middle factors are computed from the left: one linear system for the vector dR_R/du_H*, then one reverse pass
through g.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from torch import Tensor
from torch.func import grad, vjp

from lfd.core.errors import InputError
from lfd.interaction.responses import Bounds, Reward, best_response, free_curvature, limits, vector


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What the robot does, and what it expects of the person."""

    u_robot: Float[Tensor, "n"]
    u_human: Float[Tensor, "m"]
    """The person's best response to it."""
    value: float
    """R_R of both."""
    converged: bool
    """Whether the gradient vanishes, but for controls at their bounds."""
    human_solves: int
    """Best responses that were computed."""
    status: str
    """How the search ended, in the optimiser's words."""


def leader_gradient(
    reward_robot: Reward,
    reward_human: Reward,
    u_robot: Float[Tensor, "n"],
    u_human: Float[Tensor, "m"],
    *,
    bounds: Bounds | None = None,
    ridge: float = 0.0,
) -> Float[Tensor, "n"]:
    """dJ/du_R at u_H = u_H*(u_R); `bounds` are the person's, `ridge` is added to -dg/du_H.

    Raises what `response_jacobian` raises.
    """
    u_robot, u_human = vector("u_robot", u_robot), vector("u_human", u_human)
    own, through = grad(reward_robot, argnums=(0, 1))(u_robot, u_human)
    if not (torch.isfinite(own).all() and torch.isfinite(through).all()):
        raise InputError(
            f"reward_robot has no finite slope at u_robot = {u_robot.tolist()}, u_human = {u_human.tolist()}"
        )
    free, curvature = free_curvature(reward_human, u_robot, u_human, bounds, ridge)
    if not free.any():
        return own
    weight = torch.zeros_like(u_human)
    weight[free] = torch.linalg.solve(curvature, through[free])
    push = vjp(lambda u: grad(reward_human, argnums=1)(u, u_human), u_robot)[1]
    return own + push(weight)[0]


def plan_stackelberg(
    reward_robot: Reward,
    reward_human: Reward,
    u_robot_init: Float[Tensor, "n"],
    u_human_init: Float[Tensor, "m"],
    *,
    bounds: Bounds | None = None,
    robot_bounds: Bounds | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 200,
    ridge: float = 0.0,
) -> Plan:
    """A local maximum of J near `u_robot_init`, by L-BFGS-B with the gradient above.

    `bounds` are the person's, `robot_bounds` the robot's. Each best response begins at the last one, the warm start of
    a receding horizon is the plan before, shifted. Raises what `best_response` and `leader_gradient` raise.
    """
    start = vector("u_robot_init", u_robot_init)
    low, high = limits(robot_bounds, start)
    answer, solves = vector("u_human_init", u_human_init), 0

    def loss(u: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal answer, solves
        u_robot = torch.from_numpy(np.array(u))
        answer, solves = best_response(reward_human, u_robot, answer, bounds=bounds), solves + 1
        slope = leader_gradient(reward_robot, reward_human, u_robot, answer, bounds=bounds, ridge=ridge)
        return -float(reward_robot(u_robot, answer)), -slope.numpy()

    found = minimize(
        loss, torch.clamp(start, low, high).numpy(), jac=True, method="L-BFGS-B",
        bounds=list(zip(low.tolist(), high.tolist(), strict=True)),
        options={"maxiter": max_iterations, "gtol": tolerance, "ftol": 1e-15},
    )  # fmt: skip
    value, slope = loss(found.x)
    pushed = np.clip(found.x - slope, low.numpy(), high.numpy()) - found.x  # the projected gradient
    return Plan(
        u_robot=torch.from_numpy(np.array(found.x)),
        u_human=answer,
        value=-value,
        converged=bool(np.abs(pushed).max(initial=0.0) <= max(tolerance, 1e-5 * (1.0 + abs(value)))),
        human_solves=solves,
        status=str(found.message),
    )
