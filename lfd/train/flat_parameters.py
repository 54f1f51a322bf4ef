"""All parameters of a policy as one vector, so that a gradient step is a handful of operations.

The parameters become views of the vector and their gradients views of another, into which the backward pass adds.
Clipping, AdamW, the moving average and the mean over processes then each touch one tensor instead of dozens, which
for small networks is a good part of a step.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn


class FlatParameters:
    """The trainable parameters of `policy`, and AdamW on them.

    Parameters in groups of their own (`get_optim_params` of LeRobot's policies) keep the factor of their group's
    learning rate. Use `policy` as before; call `zero`, the backward pass, then `step`.
    """

    def __init__(self, policy: Any, *, betas: tuple[float, float], weight_decay: float, fused: bool = True):
        self._groups: list[tuple[Tensor, Tensor, float]] = []
        for group, rate in _groups_of(policy):
            values = torch.cat([p.detach().reshape(-1) for p in group])
            grads = torch.zeros_like(values)
            _lay(group, values, grads)
            self._groups.append((values, grads, rate))
        self._held = [nn.Parameter(values) for values, _, _ in self._groups]
        for held, (_, grads, _) in zip(self._held, self._groups, strict=True):
            held.grad = grads
        options = [{"params": [held]} for held in self._held]
        self._adam = torch.optim.AdamW(options, lr=0.0, betas=betas, weight_decay=weight_decay, fused=fused)

    @property
    def values(self) -> list[Float[Tensor, "_"]]:
        """The parameters, one vector a group."""
        return [values for values, _, _ in self._groups]

    @property
    def gradients(self) -> list[Float[Tensor, "_"]]:
        return [grads for _, grads, _ in self._groups]

    def zero(self) -> None:
        """Begin a gradient."""
        for grads in self.gradients:
            grads.zero_()

    def step(self, learning_rate: float, longest: float) -> Float[Tensor, ""]:
        """Take a step along the gradient, scaled to a norm of at most `longest`; returns the norm before."""
        norms = [torch.linalg.vector_norm(grads) for grads in self.gradients]
        norm = norms[0] if len(norms) == 1 else torch.linalg.vector_norm(torch.stack(norms))
        scale = (longest / (norm + 1e-6)).clamp(max=1.0)
        for grads in self.gradients:
            grads.mul_(scale)
        for options, (_, _, rate) in zip(self._adam.param_groups, self._groups, strict=True):
            options["lr"] = learning_rate * rate
        self._adam.step()
        return norm

    def state(self) -> dict[str, Tensor]:
        """Parameters and AdamW's memory, as `load_state` takes them."""
        kept = {}
        for number, held in enumerate(self._held):
            kept[f"{number}.values"] = held.detach().clone()
            for key, value in self._adam.state[held].items():
                kept[f"{number}.{key}"] = value.clone()
        return kept

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where `state` was taken."""
        for number, held in enumerate(self._held):
            own = {key.partition(".")[2]: value for key, value in state.items() if key.startswith(f"{number}.")}
            held.data.copy_(own.pop("values"))
            self._adam.state[held] = {
                key: value.to(held.device) if value.ndim else value.clone() for key, value in own.items()
            }


def _groups_of(policy: Any) -> list[tuple[list[nn.Parameter], float]]:
    """The parameters by group, each with its learning rate as a multiple of the policy's own one."""
    offered: list[Any] = list(policy.get_optim_params())
    groups: list[dict[str, Any]] = offered if isinstance(offered[0], dict) else [{"params": offered}]
    found = []
    for group in groups:
        own = group["lr"] / policy.config.get_optimizer_preset().lr if "lr" in group else 1.0
        params = [p for p in group["params"] if p.requires_grad]
        found += [(params, own)] if params else []
    return found


def _lay(params: list[nn.Parameter], values: Tensor, grads: Tensor) -> None:
    """Make parameters and their gradients views of two vectors."""
    at = 0
    for p in params:
        place = slice(at, at + p.numel())
        p.data, p.grad = values[place].view_as(p), grads[place].view_as(p)
        at += p.numel()
