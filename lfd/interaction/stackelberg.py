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

from lfd.core.errors import InputError
from lfd.interaction.responses import Bounds, Reward, best_response, limits, regular_curvature, slope_of, vector


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
    followers: int = 1,
) -> Float[Tensor, "n"]:
    """dJ/du_R at u_H = u_H*(u_R); `bounds` are the person's, `ridge` is added to -dg/du_H.
    `followers` as in `best_response`.

    Raises what `response_jacobian` raises.
    """
    u_robot, u_human = vector("u_robot", u_robot), vector("u_human", u_human)
    with torch.enable_grad():
        leader, follower = (u.clone().requires_grad_(True) for u in (u_robot, u_human))
        own, through = torch.autograd.grad(
            reward_robot(leader, follower), (leader, follower), allow_unused=True, materialize_grads=True
        )
    if not (torch.isfinite(own).all() and torch.isfinite(through).all()):
        raise InputError(
            f"reward_robot has no finite slope at u_robot = {u_robot.tolist()}, u_human = {u_human.tolist()}"
        )
    free, curvature = regular_curvature(reward_human, u_robot, u_human, bounds, ridge, followers)
    weight = torch.linalg.solve(curvature, (through * free).view(followers, -1, 1)).flatten()
    g, leader, _ = slope_of(reward_human, u_robot, u_human)
    if not g.requires_grad:
        return own
    (push,) = torch.autograd.grad(g, leader, weight, allow_unused=True, materialize_grads=True)
    return own + push


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
    max_gradients: int = 15_000,
    ridge: float = 0.0,
    difference: float = 0.0,
    followers: int = 1,
    response_tolerance: float = 1e-10,
) -> Plan:
    """The best point met on the way to a local maximum of J near `u_robot_init`, by L-BFGS-B with the gradient above.

    `bounds` are the person's, `robot_bounds` the robot's, whose width is the unit of each control. Each best response
    begins at the last one, the warm start of a receding horizon is the plan before, shifted. The search ends with the
    iteration in which it has computed `max_gradients` gradients. With `difference` the gradient is (J(u + e) -
    J(u - e)) / 2|e| for steps of this size, 2n best responses more: what implicit differentiation spares. `followers`
    and `response_tolerance` are those of `best_response`.

    Raises what `best_response` and `leader_gradient` raise.
    """
    start = vector("u_robot_init", u_robot_init)
    low, high = limits(robot_bounds, start)
    answer, solves = vector("u_human_init", u_human_init), 0
    best: tuple[float, Tensor, Tensor, np.ndarray] | None = None

    def value_at(u_robot: Tensor) -> float:
        nonlocal answer, solves
        answer = best_response(
            reward_human, u_robot, answer, bounds=bounds, tolerance=response_tolerance, followers=followers
        )
        solves += 1
        return float(reward_robot(u_robot, answer))

    def differences(u_robot: Tensor) -> Tensor:
        steps = difference * torch.eye(len(u_robot), dtype=torch.float64)
        ends = [value_at(u_robot + step) - value_at(u_robot - step) for step in steps]
        return torch.tensor(ends, dtype=torch.float64) / (2.0 * difference)

    width = high - low
    unit = torch.where(torch.isfinite(width) & (width > 0.0), width, 1.0).numpy()

    def loss(z: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        u_robot = torch.clamp(torch.from_numpy(z * unit), low, high)
        value, here = value_at(u_robot), answer
        if difference:
            slope = differences(u_robot)
        else:
            slope = leader_gradient(
                reward_robot, reward_human, u_robot, here, bounds=bounds, ridge=ridge, followers=followers
            )
        if best is None or value > best[0]:
            best = value, u_robot, here, slope.numpy()
        return -value, -slope.numpy() * unit

    found = minimize(
        loss, torch.clamp(start, low, high).numpy() / unit, jac=True, method="L-BFGS-B",
        bounds=list(zip((low.numpy() / unit).tolist(), (high.numpy() / unit).tolist(), strict=True)),
        options={"maxiter": max_iterations, "maxfun": max_gradients, "gtol": tolerance, "ftol": 1e-15},
    )  # fmt: skip
    assert best is not None
    value, u_robot, u_human, slope = best
    pushed = np.clip(u_robot.numpy() + slope, low.numpy(), high.numpy()) - u_robot.numpy()  # the projected gradient
    return Plan(
        u_robot=u_robot,
        u_human=u_human,
        value=value,
        converged=bool(np.abs(pushed).max(initial=0.0) <= max(tolerance, 1e-5 * (1.0 + abs(value)))),
        human_solves=solves,
        status=str(found.message),
    )
