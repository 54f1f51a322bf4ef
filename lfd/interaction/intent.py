"""What a person is after: a belief over theta, from what they do (chapter 10.6.2).

    b_t+1(theta) = p(u_H,t | x_t, u_R,t, theta) b_t(theta) / eta
    p(u_H | x, u_R, theta) ~ exp R_H(x, u_R, u_H, theta)

The proportionality hides a normaliser that depends on theta. It is kept here: without it a theta that makes everything
attractive would look likely whatever the person does.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.errors import InputError


@dataclass(frozen=True)
class IntentBelief:
    """A distribution over finitely many thetas, in log space."""

    thetas: Any
    """P parameters: (P,) or (P, D) numbers, or any sequence of P things."""
    prior: Float[Tensor, "P"]
    """Their probabilities, up to a factor."""
    log_probabilities: Float[Tensor, "P"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        prior = torch.as_tensor(self.prior, dtype=torch.float64).detach()
        if len(self.thetas) == 0:
            raise InputError("thetas is empty: a belief needs at least one possibility")
        if prior.shape != (len(self.thetas),):
            raise InputError(
                f"prior has shape {tuple(prior.shape)}, expected ({len(self.thetas)},): one for each theta"
            )
        if not torch.isfinite(prior).all() or (prior < 0.0).any() or float(prior.sum()) == 0.0:
            raise InputError(f"prior is {prior.tolist()}: give probabilities, not negative and not all 0")
        object.__setattr__(self, "prior", prior)
        object.__setattr__(self, "log_probabilities", torch.log(prior) - torch.log(prior.sum()))

    def updated(self, log_likelihood: Float[Tensor, "P"]) -> "IntentBelief":
        """The belief after an observation, whose log likelihood under each theta is given, normalised over u_H.

        Raises `InputError` for another shape, NaN, +inf, or an observation that is impossible under every theta.
        """
        given = torch.as_tensor(log_likelihood, dtype=torch.float64).detach()
        if given.shape != self.prior.shape:
            raise InputError(f"log_likelihood has shape {tuple(given.shape)}, expected {tuple(self.prior.shape)}")
        if (torch.isnan(given) | (given == torch.inf)).any():
            raise InputError(f"log_likelihood is {given.tolist()}: no entry may be NaN or +inf")
        unnormalised = self.log_probabilities + given
        eta = torch.logsumexp(unnormalised, 0)
        if eta == -torch.inf:
            raise InputError(
                "the observation is impossible under every theta that the belief holds possible: add thetas"
            )
        updated = IntentBelief(self.thetas, torch.exp(unnormalised - eta))
        object.__setattr__(updated, "log_probabilities", unnormalised - eta)  # exp may have made small ones 0
        return updated

    @property
    def probabilities(self) -> Float[Tensor, "P"]:
        return torch.exp(self.log_probabilities)

    @property
    def entropy(self) -> Float[Tensor, ""]:
        """- sum b log b [nats]."""
        return torch.special.entr(self.probabilities).sum()

    @property
    def mean(self) -> Float[Tensor, "..."]:
        """sum b theta, for thetas that are numbers or vectors."""
        return torch.tensordot(self.probabilities, torch.as_tensor(self.thetas, dtype=torch.float64), dims=1)


def boltzmann_likelihood(rewards: Float[Tensor, "P A_R A_H"], *, rationality: float) -> Float[Tensor, "P A_R A_H"]:
    """p(u_H | u_R, theta) = exp(rationality R_H) / sum over u_H of the same, for finitely many actions.

    Raises `InputError` for another shape, NaN, or a rationality that is negative.
    """
    rewards = torch.as_tensor(rewards, dtype=torch.float64)
    if rewards.ndim != 3 or 0 in rewards.shape:
        raise InputError(
            f"rewards have shape {tuple(rewards.shape)}, expected (thetas, robot's actions, person's actions)"
        )
    if not torch.isfinite(rewards).all():
        place = torch.nonzero(~torch.isfinite(rewards))[0].tolist()
        raise InputError(f"rewards{place} is {float(rewards[tuple(place)])}: every entry must be finite")
    if not 0.0 <= rationality < float("inf"):
        raise InputError(f"rationality = {rationality}: give a number from 0 (guesses) on")
    return torch.softmax(rationality * rewards, dim=2)
