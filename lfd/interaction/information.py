"""What the robot's action is expected to tell about theta, through what the person does next (chapter 10.6.2).

    I(b, u_R) = H(sum_theta b(theta) p(. | u_R, theta)) - sum_theta b(theta) H(p(. | u_R, theta))       [nats]

the mutual information of theta and u_H (Sadigh et al. 2018 use the drop of the belief's entropy, whose expectation it
is). It is never negative, and 0 where all thetas answer alike.
"""

from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.errors import InputError


def information_gain(probabilities: Float[Tensor, "P"], likelihood: Float[Tensor, "P A_R A_H"]) -> Float[Tensor, "A_R"]:
    """I(b, u_R) of each of the robot's actions [nats].

    Raises `InputError` for shapes that do not fit, or tables that do not sum to 1 over the person's actions.
    """
    b, table = _checked(probabilities, likelihood)
    marginal = torch.tensordot(b, table, dims=1)
    noise = torch.tensordot(b, torch.special.entr(table).sum(dim=2), dims=1)
    return torch.clamp(torch.special.entr(marginal).sum(dim=1) - noise, min=0.0)


def information_several_steps(
    probabilities: Float[Tensor, "P"], likelihood: Float[Tensor, "P A_R A_H"], steps: int
) -> Float[Tensor, "N"]:
    """I of each sequence of `steps` actions, all A_R^steps of them in the order of `itertools.product`, not replanned
    between.

    Given theta, answers in the same situation are independent: p(u_1, ..., u_k | theta) is the product. Raises
    `InputError` as `information_gain` does, and for more than a million joint answers.
    """
    b, table = _checked(probabilities, likelihood)
    if steps < 1 or table.shape[2] ** steps > 1_000_000:
        raise InputError(
            f"steps = {steps}: {table.shape[2]} answers a step make too many joint ones, or none; choose fewer"
        )
    noise = torch.special.entr(table).sum(dim=2)
    gains = []
    for actions in product(range(table.shape[1]), repeat=steps):
        joint = torch.ones(len(b), 1, dtype=torch.float64)
        for action in actions:
            joint = (joint[:, :, None] * table[:, action, None, :]).flatten(1)
        entropy = torch.special.entr(b @ joint).sum()
        gains.append(entropy - b @ noise[:, list(actions)].sum(dim=1))
    return torch.clamp(torch.stack(gains), min=0.0)


def _checked(
    probabilities: Float[Tensor, "P"], likelihood: Float[Tensor, "P A_R A_H"]
) -> tuple[Float[Tensor, "P"], Float[Tensor, "P A_R A_H"]]:
    b = torch.as_tensor(probabilities, dtype=torch.float64)
    table = torch.as_tensor(likelihood, dtype=torch.float64)
    if b.ndim != 1 or len(b) == 0 or table.ndim != 3 or len(table) != len(b):
        raise InputError(
            f"probabilities have shape {tuple(b.shape)}, likelihood {tuple(table.shape)}; expected (P,) and (P, "
            f"A_R, A_H)"
        )
    if not torch.isfinite(b).all() or (b < 0.0).any() or abs(float(b.sum()) - 1.0) > 1e-6:
        raise InputError(f"probabilities are {b.tolist()}: they must not be negative, and sum to 1")
    off = (table.sum(dim=2) - 1.0).abs() > 1e-6
    if off.any() or (table < 0.0).any() or not torch.isfinite(table).all():
        place = torch.nonzero(off)[0].tolist() if off.any() else torch.nonzero(~(table >= 0.0))[0].tolist()
        raise InputError(f"likelihood{place[:2]} is no distribution over the person's actions: it must sum to 1")
    return b, table
