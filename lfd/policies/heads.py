"""Action heads: what a network's last numbers mean, the loss on them, and which action to execute.

A head has no parameters. The network gives `width` raw numbers for an action of Da components, the head makes an
action or a distribution Q of them. For losses between distributions the expert P is a Gaussian of `expert_std` around
its action: how finely its actions are worth imitating. nll is -log q(u*), which is KL(P || Q) of a P without width up
to a constant.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from lfd.core.errors import RecipeError, UnknownName
from lfd.policies.losses import (
    KINDS,
    categorical_f_divergence,
    categorical_renyi2,
    gaussian_f_divergence,
    gaussian_renyi2,
    huber_loss,
    mixture_log_prob,
    mixture_renyi2,
    monte_carlo_f_divergence,
    mse,
    p_norm_loss,
)

_OF_DISTRIBUTIONS = ("nll", *KINDS)
LOSSES = {
    "point": ("mse", "p_norm", "huber"),
    "gaussian": _OF_DISTRIBUTIONS,
    "mixture": _OF_DISTRIBUTIONS,
    "discrete": _OF_DISTRIBUTIONS,
}
"""Head to the losses that it takes."""


@dataclass(frozen=True, kw_only=True)
class HeadSettings:
    """A head, its loss, and their numbers."""

    head: str
    """point, gaussian, mixture or discrete."""
    action_dim: int
    """Components of an action, Da."""
    loss: str
    """point: mse, p_norm or huber; the others: nll, kl, reverse_kl, js, tv, chi2 or hellinger2."""
    p: float = 2.0
    """Which norm p_norm is: at least 1; inf is the largest component."""
    huber_delta: float = 0.1
    """Where huber turns from quadratic to linear, in units of the action."""
    components: int = 5
    """Gaussians of the mixture."""
    bins: int = 51
    """Bins of the discrete head for each component of the action, over [-1, 1]."""
    expert_std: float = 0.05
    """Standard deviation of the Gaussian that stands for the expert around its action, in units of the action."""
    loss_samples: int = 64
    """Nodes of the losses that have no closed form: half of them for the expert, half for the learner."""
    min_std: float = 0.01
    """Smallest standard deviation that a head gives a Gaussian, in units of the action."""

    def check(self, where: str) -> None:
        """Raise `UnknownName` for names that do not exist or fit, `RecipeError` for numbers out of range."""
        if self.head not in LOSSES:
            raise UnknownName(f"head in {where}:", self.head, LOSSES)
        if self.loss not in LOSSES[self.head]:
            takers = [head for head, losses in LOSSES.items() if self.loss in losses]
            hint = f"{self.loss} is a loss of: {', '.join(takers)}." if takers else ""
            raise UnknownName(f"loss of the {self.head} head in {where}:", self.loss, LOSSES[self.head], hint)
        for key, least in (("action_dim", 1), ("p", 1), ("components", 1), ("bins", 2), ("loss_samples", 16)):
            if not getattr(self, key) >= least:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be at least {least}")
        for key in ("huber_delta", "expert_std", "min_std"):
            if not 0 < getattr(self, key) < math.inf:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0 and finite")
        if self.loss == "chi2" and self.head != "discrete" and self.min_std < self.expert_std:
            raise RecipeError(
                f"{where} min_std = {self.min_std}: chi2 of a learner narrower than the expert may be infinite; "
                f"give min_std = {self.expert_std}, the expert_std, or more"
            )


@runtime_checkable  # what make_head returns is checked in tests
class Head(Protocol):
    """What makes actions of raw numbers."""

    width: int
    """Raw numbers for an action."""

    def loss(self, raw: Float[Tensor, "*B width"], expert: Float[Tensor, "*B Da"]) -> Float[Tensor, "*B"]:
        """L(pi(x), pi*(x)) of every row."""
        ...

    def mode(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        """The action to execute."""
        ...

    def sample(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        """A draw of the action, from torch's global generator."""
        ...

    def spread(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        """Standard deviation of each component of the action."""
        ...


def make_head(settings: HeadSettings) -> Head:
    """The head that checked settings describe."""
    heads = {"point": PointHead, "gaussian": GaussianHead, "mixture": MixtureHead, "discrete": DiscreteHead}
    return heads[settings.head](settings)


class PointHead:
    """The action itself: a deterministic policy."""

    def __init__(self, settings: HeadSettings):
        self.width = settings.action_dim
        self._settings = settings

    def loss(self, raw: Float[Tensor, "*B width"], expert: Float[Tensor, "*B Da"]) -> Float[Tensor, "*B"]:
        if self._settings.loss == "mse":
            return mse(expert, raw)
        if self._settings.loss == "huber":
            return huber_loss(expert, raw, delta=self._settings.huber_delta)
        return p_norm_loss(expert, raw, p=self._settings.p)

    def mode(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        return raw

    def sample(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        return raw

    def spread(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        return torch.zeros_like(raw)


class GaussianHead:
    """Q = N(mean, std) with independent components; std = min_std + softplus(raw).

    kl, reverse_kl and hellinger2 are those of the whole action. js and tv are summed over its components: an upper
    bound of the whole's (both are subadditive over independent components), with a gradient where the whole's has none
    because one component is far off. chi2 is descended as log(1 + chi2).
    """

    def __init__(self, settings: HeadSettings):
        self.width = 2 * settings.action_dim
        self._settings = settings

    def distribution(self, raw: Float[Tensor, "*B width"]) -> tuple[Float[Tensor, "*B Da"], Float[Tensor, "*B Da"]]:
        """Mean and standard deviation."""
        mean, raw_std = raw.chunk(2, dim=-1)
        return mean, self._settings.min_std + functional.softplus(raw_std)

    def loss(self, raw: Float[Tensor, "*B width"], expert: Float[Tensor, "*B Da"]) -> Float[Tensor, "*B"]:
        mean, std = self.distribution(raw)
        kind = self._settings.loss
        if kind == "nll":
            return (((expert - mean) / std).square() / 2 + std.log() + math.log(2 * math.pi) / 2).sum(-1)
        both = (expert, torch.full_like(expert, self._settings.expert_std), mean, std)
        if kind == "chi2":
            return gaussian_renyi2(*both)
        if kind in ("js", "tv"):
            lines = (x.unsqueeze(-1) for x in both)
            return gaussian_f_divergence(*lines, kind=kind, samples=self._settings.loss_samples).sum(-1)
        return gaussian_f_divergence(*both, kind=kind)

    def mode(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        return self.distribution(raw)[0]

    def sample(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        return torch.normal(*self.distribution(raw))

    def spread(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        return self.distribution(raw)[1]


class MixtureHead:
    """Q = sum_k w_k N(mean_k, std_k): an expert that sometimes passes left and sometimes right.

    Losses but nll are sums over `loss_samples` nodes, between whole actions, because a mixture ties the components of
    an action together. js, tv and hellinger2 are therefore flat while the learner is far from the expert, the more so
    the more components an action has. chi2 is descended as log(1 + chi2).
    """

    def __init__(self, settings: HeadSettings):
        self.width = settings.components * (1 + 2 * settings.action_dim)
        self._settings = settings

    def distribution(
        self, raw: Float[Tensor, "*B width"]
    ) -> tuple[Float[Tensor, "*B M"], Float[Tensor, "*B M Da"], Float[Tensor, "*B M Da"]]:
        """Logits of the weights, means and standard deviations."""
        logits, rest = raw.split([self._settings.components, self.width - self._settings.components], dim=-1)
        means, raw_stds = rest.unflatten(-1, (self._settings.components, 2, -1)).unbind(-2)
        return logits, means, self._settings.min_std + functional.softplus(raw_stds)

    def loss(self, raw: Float[Tensor, "*B width"], expert: Float[Tensor, "*B Da"]) -> Float[Tensor, "*B"]:
        learner = self.distribution(raw)
        kind, samples = self._settings.loss, self._settings.loss_samples
        if kind == "nll":
            return -mixture_log_prob(*learner, expert)
        std = torch.full_like(expert, self._settings.expert_std)
        if kind == "chi2":
            return mixture_renyi2(expert, std, *learner, samples=samples)
        return monte_carlo_f_divergence(expert, std, *learner, kind=kind, samples=samples)

    def mode(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        """The mean of the heaviest Gaussian."""
        logits, means, _ = self.distribution(raw)
        return _of_component(means, logits.argmax(-1))

    def sample(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        logits, means, stds = self.distribution(raw)
        chosen = torch.distributions.Categorical(logits=logits).sample()
        return torch.normal(_of_component(means, chosen), _of_component(stds, chosen))

    def spread(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        logits, means, stds = self.distribution(raw)
        weights = logits.softmax(-1).unsqueeze(-1)
        mean = (weights * means).sum(-2, keepdim=True)
        return (weights * (stds.square() + (means - mean).square())).sum(-2).sqrt()


def _of_component(values: Float[Tensor, "*B M Da"], chosen: Int[Tensor, "*B"]) -> Float[Tensor, "*B Da"]:
    return values.take_along_dim(chosen[..., None, None], dim=-2).squeeze(-2)


class DiscreteHead:
    """Q: for every component of the action its own probabilities of equal bins over [-1, 1].

    P is the expert's Gaussian in the same bins; the outer bins hold what lies beyond. Components are independent, so
    that kl and reverse_kl add up, and hellinger2 and chi2 of the whole action follow from those of the components
    exactly: 1 - D and 1 + D multiply. js and tv are summed over components, chi2 is descended as log(1 + chi2), both as
    in the Gaussian head. nll is -log of the probability of the expert's bin.
    """

    def __init__(self, settings: HeadSettings):
        self.width = settings.action_dim * settings.bins
        self._settings = settings

    def log_probs(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da A"]:
        """log q of every bin of every component."""
        return raw.unflatten(-1, (self._settings.action_dim, self._settings.bins)).log_softmax(-1)

    def loss(self, raw: Float[Tensor, "*B width"], expert: Float[Tensor, "*B Da"]) -> Float[Tensor, "*B"]:
        log_q = self.log_probs(raw)
        kind, bins = self._settings.loss, self._settings.bins
        if kind == "nll":
            index = ((expert + 1) / 2 * bins).floor().clamp(0, bins - 1).long()
            return -log_q.take_along_dim(index.unsqueeze(-1), dim=-1).squeeze(-1).sum(-1)
        log_p = log_normal_bins(expert, self._settings.expert_std, bins)
        if kind == "chi2":
            return categorical_renyi2(log_p, log_q).sum(-1)
        if kind == "hellinger2":
            return -((log_p + log_q) / 2).logsumexp(-1).sum(-1).expm1()
        return categorical_f_divergence(log_p, log_q, kind=kind).sum(-1)

    def mode(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        """The mean over the likeliest bin and its neighbours: finer than a bin."""
        log_q = self.log_probs(raw)
        place = torch.arange(self._settings.bins, device=raw.device)
        near = (place - log_q.argmax(-1, keepdim=True)).abs() <= 1
        return log_q.masked_fill(~near, -math.inf).softmax(-1) @ self._centres(raw)

    def sample(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        """A bin by its probability, and a place in it."""
        index = torch.distributions.Categorical(logits=self.log_probs(raw)).sample()
        return 2 * (index + torch.rand_like(index, dtype=raw.dtype)) / self._settings.bins - 1

    def spread(self, raw: Float[Tensor, "*B width"]) -> Float[Tensor, "*B Da"]:
        q, centres = self.log_probs(raw).exp(), self._centres(raw)
        of_bins = (q * (centres - (q @ centres).unsqueeze(-1)).square()).sum(-1)
        return (of_bins + (2 / self._settings.bins) ** 2 / 12).sqrt()

    def _centres(self, like: Tensor) -> Float[Tensor, "A"]:
        bins = self._settings.bins
        return (2 * torch.arange(bins, dtype=like.dtype, device=like.device) + 1) / bins - 1


@torch.no_grad()
def log_normal_bins(mean: Float[Tensor, "*B Da"], std: float, bins: int) -> Float[Tensor, "*B Da A"]:
    """Log-probabilities under N(mean, std) of equal bins over [-1, 1], the first and last one reaching to infinity."""
    edges = torch.linspace(-1, 1, bins + 1, dtype=mean.dtype, device=mean.device)
    edges[0], edges[-1] = -math.inf, math.inf
    z = (edges - mean.unsqueeze(-1)) / std
    low, high = z[..., :-1], z[..., 1:]
    # Bins above the mean are mirrored below it: there log Phi tells masses apart that 1 - Phi rounds to 0.
    above = low + high > 0
    low, high = torch.where(above, -high, low), torch.where(above, -low, high)
    log_low, log_high = torch.special.log_ndtr(low), torch.special.log_ndtr(high)
    return log_high + torch.log1p(-(log_low - log_high).exp())
