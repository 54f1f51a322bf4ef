"""What a person does about what the robot does: u_H*(u_R) = argmax R_H(u_R, u_H), and how it changes with u_R.

    g(u_R, u_H) = dR_H / du_H = 0 at u_H*                        the necessary condition
    dg/du_R + dg/du_H du_H*/du_R = 0                             differentiated (chapter 10.6.1; Sadigh et al. 2016)
    du_H*/du_R = - (dg/du_H)^-1 dg/du_R                          a linear system, no inverse is formed

Within bounds, a control that R_H pushes against its bound stays there: its row of du_H*/du_R is 0, and the system is
that of the free controls. Where a control is at its bound and not pushed, the derivative exists from one side only, and
is taken as if it were free.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.func import grad, hessian, jacrev

from lfd.core.errors import InputError

Reward = Callable[[Tensor, Tensor], Tensor]
"""(u_robot, u_human) to a scalar."""
Bounds = tuple[Tensor | float, Tensor | float]
"""Lowest and highest controls, one number or one for each."""
MOST_STEPS = 200
FARTHEST = 1e12
"""Controls beyond which R_H is taken to grow without end."""
SINGULAR = 1e-10
"""Smallest curvature, as a part of the largest, that counts as one."""


class SingularResponse(InputError):
    """The person's reward is flat along some direction at their answer: it does not decide what they do."""


class NoResponse(InputError):
    """The person's reward has no maximum that could be found."""


def best_response(
    reward_human: Reward,
    u_robot: Float[Tensor, "n"],
    u_human_init: Float[Tensor, "m"],
    *,
    bounds: Bounds | None = None,
    tolerance: float = 1e-10,
) -> Float[Tensor, "m"]:
    """u_H*, a local maximum of R_H near `u_human_init`, by Newton's method on the free controls with a line search.

    Where -d2R_H/du_H2 is not positive definite, its eigenvalues are replaced by their absolute values, so that every
    step goes up. `tolerance` bounds the gradient's largest free component, relative to 1 + the largest gradient met.

    Raises `SingularResponse` where the free Hessian is singular at the answer, `NoResponse` where R_H grows without end
    or the search does not converge, `InputError` for shapes that do not fit, NaN, or bounds that cross.
    """
    u, u_robot = vector("u_human_init", u_human_init), vector("u_robot", u_robot)
    low, high = limits(bounds, u)
    u = torch.clamp(u, low, high)
    slope, curve, value = _derivatives(reward_human, u_robot)
    scale, largest = 1.0, 0.0
    for _ in range(MOST_STEPS):
        g = slope(u)
        _check_finite(g, u)
        free = free_controls(u, g, low, high)
        if not free.any():
            return u
        largest = float(g[free].abs().max())
        scale = max(scale, largest)
        size, directions = torch.linalg.eigh(-curve(u)[free][:, free])
        steepest = float(size.abs().max())
        if largest <= tolerance * scale:
            if float(size.min()) >= -SINGULAR * steepest:
                _check_regular(size)
                return u
            step = directions[:, 0] * 1e-3 * (1.0 + float(u.abs().max()))  # a saddle: go along what curves upwards
            ends = [_moved(u, free, sign * step, low, high) for sign in (1.0, -1.0)]
            u = max(ends, key=lambda tried: float(value(tried)))
            continue
        least = max(SINGULAR * steepest, largest / (FARTHEST * (1.0 + float(u.abs().max()))))
        step = directions @ ((directions.T @ g[free]) / torch.clamp(size.abs(), min=least))
        moved = _search(value, u, free, step, g[free], low, high)
        if moved is None and largest <= 1e-6 * scale:  # rounding: nothing nearby is better
            _check_regular(size)
            return u
        if moved is None or float(moved.abs().max()) > FARTHEST:
            break
        u = moved
    raise NoResponse(
        f"the person's best response was not found: at u_human = {u.tolist()} the largest slope is {largest:.2g}. "
        "R_H may grow without end: give bounds, or a reward that punishes large controls"
    )


def response_jacobian(
    reward_human: Reward,
    u_robot: Float[Tensor, "n"],
    u_human: Float[Tensor, "m"],
    *,
    bounds: Bounds | None = None,
    ridge: float = 0.0,
) -> Float[Tensor, "m n"]:
    """du_H*/du_R at a best response; `ridge` is added to -d2R_H/du_H2, for rewards that are flat.

    Raises `SingularResponse` where the free Hessian is singular, `InputError` for shapes that do not fit or NaN.
    """
    u_robot, u_human = vector("u_robot", u_robot), vector("u_human", u_human)
    free, curvature = free_curvature(reward_human, u_robot, u_human, bounds, ridge)
    mixed = jacrev(grad(reward_human, argnums=1), argnums=0)(u_robot, u_human)
    jacobian = torch.zeros(len(u_human), len(u_robot), dtype=torch.float64)
    if free.any():
        jacobian[free] = torch.linalg.solve(curvature, mixed[free])
    return jacobian


def free_curvature(
    reward_human: Reward, u_robot: Float[Tensor, "n"], u_human: Float[Tensor, "m"], bounds: Bounds | None, ridge: float
) -> tuple[Bool[Tensor, "m"], Float[Tensor, "f f"]]:
    """Which controls are free at a best response, and -dg/du_H of these, regular."""
    slope, curve, _ = _derivatives(reward_human, u_robot)
    g = slope(u_human)
    _check_finite(g, u_human)
    free = free_controls(u_human, g, *limits(bounds, u_human))
    curvature = -curve(u_human)[free][:, free] + ridge * torch.eye(int(free.sum()), dtype=torch.float64)
    if free.any():
        _check_regular(torch.linalg.eigvalsh(curvature))
    return free, curvature


def limits(bounds: Bounds | None, u: Float[Tensor, "m"]) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
    """Lowest and highest controls, for each of `u`."""
    given = (-torch.inf, torch.inf) if bounds is None else bounds
    low, high = (torch.as_tensor(end, dtype=torch.float64).detach() for end in given)
    if any(end.shape not in (torch.Size(()), u.shape) for end in (low, high)):
        raise InputError(
            f"bounds have shapes {tuple(low.shape)}, {tuple(high.shape)}; give one number or {len(u)} each"
        )
    low, high = low.expand(u.shape), high.expand(u.shape)
    if not (low <= high).all():
        raise InputError(f"bounds cross or are NaN: low {low.tolist()}, high {high.tolist()}")
    return low, high


def free_controls(
    u: Float[Tensor, "m"], g: Float[Tensor, "m"], low: Float[Tensor, "m"], high: Float[Tensor, "m"]
) -> Bool[Tensor, "m"]:
    """Controls that no bound holds: within them, or pushed away from the bound that they are at."""
    return ~(((u <= low) & (g < 0.0)) | ((u >= high) & (g > 0.0)))


def _derivatives(reward: Reward, u_robot: Tensor) -> tuple[Callable, Callable, Callable]:
    """g, dg/du_H and R_H as functions of u_H."""
    slope, curve = grad(reward, argnums=1), hessian(reward, argnums=1)
    return (lambda u: slope(u_robot, u)), (lambda u: curve(u_robot, u)), (lambda u: reward(u_robot, u).detach())


def _moved(u: Tensor, free: Tensor, step: Tensor, low: Tensor, high: Tensor) -> Tensor:
    moved = u.clone()
    moved[free] += step
    return torch.clamp(moved, low, high)


def _search(
    value: Callable, u: Tensor, free: Tensor, step: Tensor, slope: Tensor, low: Tensor, high: Tensor
) -> Tensor | None:
    """The first point along the projected step that gains enough (Armijo; Bertsekas 1982); none if none gains at
    all."""
    here, length = float(value(u)), 1.0
    for _ in range(60):
        moved = _moved(u, free, length * step, low, high)
        gain, promised = float(value(moved)) - here, float(slope @ (moved - u)[free])
        if gain >= 1e-4 * promised and promised > 0.0:
            if torch.equal(moved, u):
                return None
            return moved
        length /= 2.0
    return None


def _check_regular(curvatures: Float[Tensor, "f"]) -> None:
    smallest, largest = float(curvatures.min()), float(curvatures.abs().max())
    if smallest <= SINGULAR * largest or largest == 0.0:
        raise SingularResponse(
            f"the curvatures of the person's reward at their answer run from {smallest:.3g} to {largest:.3g}: "
            f"along a flat "
            "direction anything is as good; add a small cost of effort to R_H, or give ridge=1e-6"
        )


def _check_finite(g: Tensor, u: Tensor) -> None:
    if not torch.isfinite(g).all():
        raise InputError(f"reward_human has the slope {g.tolist()} at u_human = {u.tolist()}: it must be finite there")


def vector(name: str, values: Tensor) -> Float[Tensor, "k"]:
    """Controls as they enter. Raises `InputError` for other shapes and entries that are not finite."""
    given = torch.as_tensor(values, dtype=torch.float64).detach()
    if given.ndim != 1:
        raise InputError(f"{name} has shape {tuple(given.shape)}, expected one dimension")
    if not torch.isfinite(given).all():
        raise InputError(f"{name} is {given.tolist()}: every entry must be finite")
    return given
