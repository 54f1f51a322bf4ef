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

from lfd.core.errors import InputError

Reward = Callable[[Tensor, Tensor], Tensor]
"""(u_robot, u_human) to a scalar."""
Derivatives = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""(u_robot, u_human) to R_H, g (m,) and a block of -dg/du_H for each follower (followers, k, k), in closed form. Where
u_robot requires its gradient, g is made of operations that can be differentiated by it."""
Bounds = tuple[Tensor | float, Tensor | float]
"""Lowest and highest controls, one number or one for each."""
MOST_STEPS = 200
FARTHEST = 1e12
"""Controls beyond which R_H is taken to grow without end."""
AT_BOUND = 1e-9
"""Distance from a bound, relative to 1 + the bound, that counts as none: rounding ends steps there, for good."""
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
    ridge: float = 0.0,
    followers: int = 1,
    derivatives: Derivatives | None = None,
) -> Float[Tensor, "m"]:
    """u_H*, a local maximum of R_H near `u_human_init`, by Newton's method on the free controls with a line search.

    Where -d2R_H/du_H2 is not positive definite, its eigenvalues are replaced by their absolute values, so that every
    step goes up. `tolerance` bounds the gradient's largest free component, relative to 1 + the largest gradient met.
    With `followers` the controls are those of so many people, one after the other, whose rewards add up and have no
    person's controls in common with another's: the Hessian's blocks then cost what one of them does. `derivatives` of
    R_H in closed form, where there are such, spare automatic differentiation, which takes most of the time.

    Raises `SingularResponse` where the free Hessian is singular at the answer, unless there is a `ridge`: then people
    stay where they were along directions in which all is as good to them. Raises `NoResponse` where R_H grows without
    end or the search does not converge, `InputError` for shapes that do not fit, NaN, or bounds that cross.
    """
    u, u_robot = vector("u_human_init", u_human_init), vector("u_robot", u_robot)
    low, high = limits(bounds, u)
    u = torch.clamp(u, low, high)

    closed = None if derivatives is None else _remembering(derivatives)

    def value(u: Tensor) -> Tensor:
        return (reward_human(u_robot, u) if closed is None else closed(u_robot, u)[0]).detach()

    scale, largest, here = 1.0, 0.0, float(value(u))
    for _ in range(MOST_STEPS):
        g, curvature, _ = slope_and_curvature(reward_human, u_robot, u, (low, high), followers, closed)
        largest = float(g.abs().max())
        scale = max(scale, largest)
        size, directions = torch.linalg.eigh(curvature)
        steepest = size.abs().amax(dim=1, keepdim=True)
        if largest <= tolerance * scale:
            if (size >= -SINGULAR * steepest).all():
                _regular(size, ridge)
                return u
            worst = int((size[:, 0] / steepest[:, 0]).argmin())  # a saddle: go along what curves upwards
            step = torch.zeros_like(size)
            step[worst] = directions[worst, :, 0] * 1e-3 * (1.0 + float(u.abs().max()))
            ends = [torch.clamp(u + sign * step.flatten(), low, high) for sign in (1.0, -1.0)]
            here, u = max(((float(value(tried)), tried) for tried in ends), key=lambda tried: tried[0])
            continue
        least = torch.clamp(SINGULAR * steepest, min=largest / (FARTHEST * (1.0 + float(u.abs().max()))))
        turned = (directions.mT @ g.view(followers, -1, 1))[..., 0] / torch.maximum(size.abs(), least)
        newton = (directions @ turned[..., None]).flatten()
        moved, there = _search(value, u, here, newton, g, low, high)
        if moved is None:  # bounds may bend Newton's step away from what is better, the gradient's never
            moved, there = _search(value, u, here, g / float(steepest.max()), g, low, high)
        if moved is None and largest <= 1e-6 * scale:  # rounding: nothing nearby is better
            _regular(size, ridge)
            return u
        if moved is None or float(moved.abs().max()) > FARTHEST:
            break
        u, here = moved, there
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
    """du_H*/du_R at a best response; `ridge` is added to -d2R_H/du_H2 where that is singular.

    Raises `SingularResponse` where the free Hessian is singular, with the ridge if there is one, `InputError` for
    shapes that do not fit or NaN.
    """
    u_robot, u_human = vector("u_robot", u_robot), vector("u_human", u_human)
    free, curvature, _ = regular_curvature(reward_human, u_robot, u_human, bounds, ridge)
    g, leader, _ = slope_of(reward_human, u_robot, u_human)
    mixed = rows(g, leader, torch.eye(len(g), dtype=torch.float64))
    return torch.linalg.solve(curvature[0], mixed * free[:, None])


def regular_curvature(
    reward_human: Reward,
    u_robot: Float[Tensor, "n"],
    u_human: Float[Tensor, "m"],
    bounds: Bounds | None,
    ridge: float,
    followers: int = 1,
    derivatives: Derivatives | None = None,
) -> tuple[Bool[Tensor, "m"], Float[Tensor, "followers k k"], float]:
    """Which controls are free at a best response, -dg/du_H there, as `slope_and_curvature` has it, and what had to be
    added to its diagonal."""
    within = limits(bounds, u_human)
    _, curvature, free = slope_and_curvature(reward_human, u_robot, u_human, within, followers, derivatives)
    flat = _regular(torch.linalg.eigvalsh(curvature), ridge)
    if not flat.any():
        return free, curvature, 0.0
    curvature = curvature + ridge * torch.diag_embed(flat.double()[:, None].expand(-1, curvature.shape[1]))
    _regular(torch.linalg.eigvalsh(curvature), 0.0)
    return free, curvature, ridge


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
    """Controls that no bound holds: within them, or pushed away from the bound that they are at, to `AT_BOUND`."""
    at_low, at_high = u <= low + AT_BOUND * (1.0 + low.abs()), u >= high - AT_BOUND * (1.0 + high.abs())
    return ~((at_low & (g < 0.0)) | (at_high & (g > 0.0)))


def slope_of(
    reward: Reward, u_robot: Float[Tensor, "n"], u_human: Float[Tensor, "m"], *, by_leader: bool = True
) -> tuple[Float[Tensor, "m"], Float[Tensor, "n"], Float[Tensor, "m"]]:
    """g = dR/du_H, and the u_R (unless told not to) and u_H that it can be differentiated by."""
    with torch.enable_grad():
        leader = u_robot.detach().clone().requires_grad_(by_leader)
        follower = u_human.detach().clone().requires_grad_(True)
        value = reward(leader, follower)
        if not value.requires_grad:
            return torch.zeros_like(follower), leader, follower
        (g,) = torch.autograd.grad(value, follower, create_graph=True, allow_unused=True, materialize_grads=True)
    return g, leader, follower


def slope_and_curvature(
    reward: Reward,
    u_robot: Float[Tensor, "n"],
    u_human: Float[Tensor, "m"],
    bounds: tuple[Tensor, Tensor],
    followers: int,
    derivatives: Derivatives | None = None,
) -> tuple[Float[Tensor, "m"], Float[Tensor, "followers k k"], Bool[Tensor, "m"]]:
    """g and -dg/du_H of each follower, for the free controls: others have slope 0, and the block's largest curvature on
    the diagonal alone; and which are free.

    One batched reverse pass for the rows takes an eighth of `torch.func.hessian`'s time. Raises `InputError` for a
    slope that is not finite.
    """
    if derivatives is not None:
        _, g, curvature = derivatives(u_robot, u_human)
    else:
        g, _, follower = slope_of(reward, u_robot, u_human, by_leader=False)
        size = len(g) // followers
        each = torch.eye(size, dtype=torch.float64).repeat(1, followers)
        curvature = -rows(g, follower, each).view(size, followers, size).transpose(0, 1)
        g = g.detach()
    _check_finite(g, u_human)
    is_free = free_controls(u_human, g, *bounds)
    free = is_free.double().view(followers, -1)
    curvature = curvature * free[:, :, None] * free[:, None, :]
    largest = curvature.abs().amax(dim=(1, 2))
    largest = torch.where(largest > 0.0, largest, 1.0)
    return g * free.flatten(), curvature + torch.diag_embed((1.0 - free) * largest[:, None]), is_free


def rows(g: Float[Tensor, "m"], by: Float[Tensor, "k"], each: Float[Tensor, "r m"]) -> Float[Tensor, "r k"]:
    """Each weighted sum of g, as `slope_of` gave it, differentiated."""
    if not g.requires_grad:
        return torch.zeros(len(each), len(by), dtype=torch.float64)
    return torch.autograd.grad(g, by, each, is_grads_batched=True, allow_unused=True, materialize_grads=True)[0]


def _search(
    value: Callable, u: Tensor, here: float, step: Tensor, slope: Tensor, low: Tensor, high: Tensor
) -> tuple[Tensor | None, float]:
    """The first point along the projected step that gains enough (Armijo; Bertsekas 1982), none if none gains at all;
    and the value there."""
    length = 1.0
    for _ in range(60):
        moved = torch.clamp(u + length * step, low, high)
        there, promised = float(value(moved)), float(slope @ (moved - u))
        if there - here >= 1e-4 * promised and promised > 0.0:
            return (None, here) if torch.equal(moved, u) else (moved, there)
        length /= 2.0
    return None, here


def _remembering(derivatives: Derivatives) -> Derivatives:
    """The same, which answers at once when it is asked about the same tensor again."""
    last: tuple[Tensor, tuple[Tensor, Tensor, Tensor]] | None = None

    def remembered(u_robot: Tensor, u_human: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        nonlocal last
        if last is None or last[0] is not u_human:
            last = u_human, derivatives(u_robot, u_human)
        return last[1]

    return remembered


def _regular(curvatures: Float[Tensor, "followers k"], ridge: float) -> Bool[Tensor, "followers"]:
    """Whose curvature is singular. Raises `SingularResponse` for anyone's if there is no ridge to help."""
    smallest, largest = curvatures.amin(dim=1), curvatures.abs().amax(dim=1)
    flat = smallest <= SINGULAR * largest
    if ridge == 0.0 and flat.any():
        at = int(flat.double().argmax())
        raise SingularResponse(
            f"the curvatures of the person's reward at their answer run from {float(smallest[at]):.3g} to "
            f"{float(largest[at]):.3g}: along a flat "
            "direction anything is as good; add a small cost of effort to reward_human, or give ridge=1e-6, or more"
        )
    return flat


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
