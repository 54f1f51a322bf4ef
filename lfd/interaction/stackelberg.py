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
from lfd.interaction.responses import (
    Bounds,
    Derivatives,
    Reward,
    best_response,
    limits,
    regular_curvature,
    slope_of,
    vector,
)


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
    gradients: int
    """Gradients that were computed."""
    status: str
    """How the search ended, in the optimiser's words."""
    ridge: float = 0.0
    """What was added to -d2R_H/du_H2 where it was singular on the way; 0 where it never was."""


def leader_gradient(
    reward_robot: Reward,
    reward_human: Reward,
    u_robot: Float[Tensor, "n"],
    u_human: Float[Tensor, "m"],
    *,
    bounds: Bounds | None = None,
    ridge: float = 0.0,
    followers: int = 1,
    derivatives: Derivatives | None = None,
) -> Float[Tensor, "n"]:
    """dJ/du_R at u_H = u_H*(u_R); `bounds` are the person's, `ridge` as in `response_jacobian`, `followers` and
    `derivatives` as in `best_response`.

    Raises what `response_jacobian` raises.
    """
    u_robot, u_human = vector("u_robot", u_robot), vector("u_human", u_human)
    return _gradient_and_ridge(reward_robot, reward_human, u_robot, u_human, bounds, ridge, followers, derivatives)[1]


def _gradient_and_ridge(
    reward_robot: Reward,
    reward_human: Reward,
    u_robot: Float[Tensor, "n"],
    u_human: Float[Tensor, "m"],
    bounds: Bounds | None,
    ridge: float,
    followers: int,
    derivatives: Derivatives | None,
) -> tuple[float, Float[Tensor, "n"], float]:
    """J, its gradient, and what was added to the person's curvature for it."""
    with torch.enable_grad():
        leader, follower = (u.clone().requires_grad_(True) for u in (u_robot, u_human))
        value = reward_robot(leader, follower)
        own, through = torch.autograd.grad(value, (leader, follower), allow_unused=True, materialize_grads=True)
    if not (torch.isfinite(own).all() and torch.isfinite(through).all()):
        raise InputError(
            f"reward_robot has no finite slope at u_robot = {u_robot.tolist()}, u_human = {u_human.tolist()}"
        )
    free, curvature, added = regular_curvature(reward_human, u_robot, u_human, bounds, ridge, followers, derivatives)
    weight = torch.linalg.solve(curvature, (through * free).view(followers, -1, 1)).flatten()
    if derivatives is None:
        g, leader, _ = slope_of(reward_human, u_robot, u_human)
    else:
        with torch.enable_grad():
            _, g, _ = derivatives(leader, u_human)
    if not g.requires_grad:
        return float(value.detach()), own, added
    (push,) = torch.autograd.grad(g @ weight, leader, allow_unused=True, materialize_grads=True)
    return float(value.detach()), own + push, added


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
    derivatives: Derivatives | None = None,
    response_tolerance: float = 1e-10,
) -> Plan:
    """The best point met on the way to a local maximum of J near `u_robot_init`, by L-BFGS-B with the gradient above.

    `bounds` are the person's, `robot_bounds` the robot's, whose width is the unit of each control. Each best response
    begins at the last one, the warm start of a receding horizon is the plan before, shifted. The search ends with the
    iteration in which it has computed `max_gradients` gradients. With `difference` the gradient is (J(u + e) -
    J(u - e)) / 2|e| for steps of this size, 2n best responses more: what implicit differentiation spares. `ridge`,
    `followers`, `derivatives` and `response_tolerance` are those of `best_response`; a person whose answer is
    singular is refused unless there is a ridge, and the plan tells whether it was needed.

    Raises what `best_response` and `leader_gradient` raise.
    """
    start = vector("u_robot_init", u_robot_init)
    low, high = limits(robot_bounds, start)
    answer, solves = vector("u_human_init", u_human_init), 0
    best: tuple[float, Tensor, Tensor, np.ndarray] | None = None
    added = 0.0

    def respond(u_robot: Tensor) -> Tensor:
        nonlocal answer, solves
        answer = best_response(
            reward_human, u_robot, answer, bounds=bounds, tolerance=response_tolerance, ridge=ridge,
            followers=followers, derivatives=derivatives,
        )  # fmt: skip
        solves += 1
        return answer

    def differences(u_robot: Tensor) -> Tensor:
        steps = difference * torch.eye(len(u_robot), dtype=torch.float64)
        ends = [[float(reward_robot(u, respond(u))) for u in (u_robot + step, u_robot - step)] for step in steps]
        return (torch.tensor(ends, dtype=torch.float64) @ torch.tensor([1.0, -1.0]).double()) / (2.0 * difference)

    width = high - low
    unit = torch.where(torch.isfinite(width) & (width > 0.0), width, 1.0).numpy()

    def loss(z: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best, added
        u_robot = torch.clamp(torch.from_numpy(z * unit), low, high)
        here = respond(u_robot)
        if difference:
            value, slope = float(reward_robot(u_robot, here)), differences(u_robot)
        else:
            value, slope, ridge_here = _gradient_and_ridge(
                reward_robot, reward_human, u_robot, here, bounds, ridge, followers, derivatives
            )
            added = max(added, ridge_here)
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
        gradients=int(found.nfev),
        status=str(found.message),
        ridge=added,
    )
