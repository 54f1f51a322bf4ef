"""Losses L(pi(x), pi*(x)) of behaviour cloning: norms between actions, f-divergences between their distributions.

    pi_hat = argmin_pi  sum_xi sum_{x in xi}  L(pi(x), pi*(x))        (chapter 10.2)

P is the expert's distribution, Q the learner's. For a convex f with f(1) = 0,

    D_f(P || Q) = E_Q[ f(p/q) ]  >=  0,   and 0 where P = Q        (Csiszar 1967; Liese and Vajda 2006)

| kind       | f(t)              | D_f(P || Q)                                                     | in     |
| ---------- | ----------------- | --------------------------------------------------------------- | ------ |
| kl         | t log t           | KL(P || Q) = E_P[log p/q], the forward one                      | [0, inf] |
| reverse_kl | -log t            | KL(Q || P) = E_Q[log q/p]                                       | [0, inf] |
| js         | (t log t - (t + 1) log (t+1)/2) / 2 | KL(P || M)/2 + KL(Q || M)/2, M = (P + Q)/2    | [0, log 2] |
| tv         | abs(t - 1) / 2    | integral of abs(p - q) / 2                                      | [0, 1] |
| chi2       | (t - 1)^2         | integral of p^2/q, less 1 (Pearson)                             | [0, inf] |
| hellinger2 | 1 - sqrt t        | 1 - integral of sqrt(p q)                                       | [0, 1] |

Logarithms are natural. What each makes a learner do: Ke et al. 2020, "Imitation learning as f-divergence minimization".

Gaussians are diagonal. Where no closed form exists, expectations are sums over fixed nodes z (`_nodes`), carried to
the distributions by x = mean + std z: the value is reproducible, its gradient is that of the sum, and every term is 0
where p = q. js, tv and hellinger2 are taken under M, where the summands are bounded functions of log p/q.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from lfd.core.errors import InputError, UnknownName

KINDS = ("kl", "reverse_kl", "js", "tv", "chi2", "hellinger2")
SAMPLES = 16384
"""Nodes of a sum, half of them for P and half for Q. Errors that were met in js: below 1e-9 in one
component of an action; in js and tv: up to 4e-4 in three and 1.5e-3 in seven."""
LOG_ZERO = -1e4
"""Stands for log 0: exp of it is 0 in every float type, and 0 times it is 0."""
LOG_2 = math.log(2)


# Between actions. The second argument's shape is left to `_same_shape`, whose sentence the caller should read.
def mse(expert: Float[Tensor, "*B Da"], learner: Float[Tensor, "..."]) -> Float[Tensor, "*B"]:
    """|u - u*|_2^2 / Da.

    Raises `InputError` for shapes that differ, as every function here.
    """
    _same_shape(expert, learner)
    return (learner - expert).square().mean(-1)


def p_norm_loss(
    expert: Float[Tensor, "*B Da"], learner: Float[Tensor, "..."], *, p: float | int
) -> Float[Tensor, "*B"]:
    """|u - u*|_p = (sum_i |u_i - u*_i|^p)^(1/p), the norm itself; max_i |u_i - u*_i| for p = inf.

    Where it has a kink its gradient is a subgradient: 0 at u = u*.

    Raises `InputError` for p < 1, which is no norm.
    """
    _same_shape(expert, learner)
    if not p >= 1:
        raise InputError(f"p = {p} is no norm; give p >= 1, or inf for the largest component")
    away = learner - expert
    # |u|_p = m |u/m|_p keeps u^p from underflow; m may be a constant: the gradient does not depend on the length of u.
    largest = away.detach().abs().amax(-1, keepdim=True)
    largest = torch.where(largest > 0, largest, 1)
    return largest.squeeze(-1) * torch.linalg.vector_norm(away / largest, ord=float(p), dim=-1)


def huber_loss(
    expert: Float[Tensor, "*B Da"], learner: Float[Tensor, "..."], *, delta: float | int
) -> Float[Tensor, "*B"]:
    """sum_i h(u_i - u*_i) with h(e) = e^2/2 for |e| <= delta, else delta (|e| - delta/2) (Huber 1964).

    Raises `InputError` for delta <= 0.
    """
    _same_shape(expert, learner)
    if not 0 < delta < math.inf:
        raise InputError(f"delta = {delta}: must be greater than 0 and finite; mse has no linear part")
    return functional.huber_loss(learner, expert, reduction="none", delta=float(delta)).sum(-1)


# Between categorical distributions.
def f_divergence(
    expert_probs: Float[Tensor, "*B A"], learner_logits: Float[Tensor, "..."], *, kind: str
) -> Float[Tensor, "*B"]:
    """D_f(P || Q) of p = expert_probs, which may be 0, and q = softmax(learner_logits), which are finite.

    reverse_kl is inf, with gradient 0, where p is 0 and q is not; chi2 ends at the largest number of its type.

    Raises `UnknownName` for a kind that does not exist, `InputError` for shapes that differ or p that is no
    distribution.
    """
    _same_shape(expert_probs, learner_logits)
    if (expert_probs < 0).any() or ((expert_probs.sum(-1) - 1).abs() > 1e-3).any():
        raise InputError("the expert's probabilities are negative or do not sum to 1 over the last axis")
    log_p = expert_probs.clamp(min=torch.finfo(expert_probs.dtype).tiny).log()
    log_p = torch.where(expert_probs > 0, log_p, LOG_ZERO)
    log_q = learner_logits.log_softmax(-1)
    value = categorical_f_divergence(log_p, log_q, kind=kind)
    if kind == "reverse_kl":
        return torch.where(((expert_probs == 0) & (log_q.exp() > 0)).any(-1), math.inf, value)
    return value


def categorical_f_divergence(
    log_p: Float[Tensor, "*B A"], log_q: Float[Tensor, "*B A"], *, kind: str
) -> Float[Tensor, "*B"]:
    """D_f(P || Q) of two categorical distributions by their finite log-probabilities.

    Raises `UnknownName` for a kind that does not exist.
    """
    _check_kind(kind)
    ratio, p, q = log_p - log_q, log_p.exp(), log_q.exp()
    if kind == "kl":
        return (p * ratio).sum(-1)
    if kind == "reverse_kl":
        return -(q * ratio).sum(-1)
    if kind == "js":  # p/m = 2 / (1 + q/p)
        of_p, of_q = LOG_2 - functional.softplus(-ratio), LOG_2 - functional.softplus(ratio)
        return (p * of_p + q * of_q).sum(-1) / 2
    if kind == "tv":
        return (p - q).abs().sum(-1) / 2
    if kind == "hellinger2":  # = sum (sqrt p - sqrt q)^2 / 2, which does not cancel
        return ((log_p / 2).exp() - (log_q / 2).exp()).square().sum(-1) / 2
    return _expm1(categorical_renyi2(log_p, log_q))


def categorical_renyi2(log_p: Float[Tensor, "*B A"], log_q: Float[Tensor, "*B A"]) -> Float[Tensor, "*B"]:
    """log(1 + chi2) = log sum p^2/q, Renyi's divergence of order 2.

    chi2 grows so fast that a gradient step of it overflows; its logarithm has the same minimum.
    """
    return (2 * log_p - log_q).logsumexp(-1)


# Between diagonal Gaussians.
def gaussian_f_divergence(
    mean_expert: Float[Tensor, "*B Da"],
    std_expert: Float[Tensor, "..."],
    mean_learner: Float[Tensor, "..."],
    std_learner: Float[Tensor, "..."],
    *,
    kind: str,
    samples: int = SAMPLES,
) -> Float[Tensor, "*B"]:
    """D_f(P || Q) of diagonal Gaussians; stds are greater than 0.

    Closed form: kl, reverse_kl, hellinger2, chi2 (inf, with gradient 0, unless 2 std_learner^2 > std_expert^2 in
    every component; it ends at the largest number of its type), and tv for Da = 1 and where the stds are equal. By
    `samples` nodes: js, and tv elsewhere.

    Raises `UnknownName` for a kind that does not exist, `InputError` for shapes that differ.
    """
    _check_kind(kind)
    for other in (std_expert, mean_learner, std_learner):
        _same_shape(mean_expert, other)
    p, q = (mean_expert, std_expert), (mean_learner, std_learner)
    if kind == "kl":
        return _gaussian_kl(*p, *q)
    if kind == "reverse_kl":
        return _gaussian_kl(*q, *p)
    if kind == "hellinger2":
        # 1 - BC with Bhattacharyya's coefficient BC = prod sqrt(2 s t / (s^2 + t^2)) exp(-(m - n)^2 / 4(s^2 + t^2))
        both = std_expert.square() + std_learner.square()
        log_bc = (2 * std_expert * std_learner / both).log() / 2 - (mean_expert - mean_learner).square() / (4 * both)
        return -log_bc.sum(-1).expm1()
    if kind == "chi2":
        finite = (2 * std_learner.square() > std_expert.square()).all(-1)
        return torch.where(finite, _expm1(gaussian_renyi2(*p, *q)), math.inf)
    if kind == "tv" and mean_expert.shape[-1] == 1:
        return _gaussian_tv_on_a_line(*(x.squeeze(-1) for x in (*p, *q)))
    z, weights = _nodes(samples // 2, mean_expert.shape[-1], mean_expert)
    under_p, under_q = (
        _BOUNDED[kind](_log_normal(x, *p) - _log_normal(x, *q)) @ weights
        for x in (mean.unsqueeze(-2) + std.unsqueeze(-2) * z for mean, std in (p, q))
    )
    value = (under_p + under_q) / 2
    if kind == "tv":
        return torch.where((std_expert == std_learner).all(-1), _gaussian_tv_of_equal_stds(*p, *q), value)
    return value


def gaussian_renyi2(
    mean_expert: Float[Tensor, "*B Da"],
    std_expert: Float[Tensor, "*B Da"],
    mean_learner: Float[Tensor, "*B Da"],
    std_learner: Float[Tensor, "*B Da"],
) -> Float[Tensor, "*B"]:
    """log(1 + chi2) = sum_i [ log(t^2 / (s sqrt v)) + (m - n)^2 / v ], v = 2 t^2 - s^2, P = N(m, s), Q = N(n, t).

    Meaningless, yet finite, where v <= 0 in a component: chi2 is infinite there.
    """
    v = 2 * std_learner.square() - std_expert.square()
    v = torch.where(v > 0, v, 1)
    away = (mean_expert - mean_learner).square() / v
    return (2 * std_learner.log() - std_expert.log() - v.log() / 2 + away).sum(-1)


def _gaussian_kl(m: Tensor, s: Tensor, n: Tensor, t: Tensor) -> Tensor:
    """KL(N(m, s) || N(n, t)) = sum_i [ log(t/s) + (s^2 + (m - n)^2) / 2 t^2 - 1/2 ]."""
    return ((t / s).log() + ((s / t).square() + ((m - n) / t).square() - 1) / 2).sum(-1)


def _gaussian_tv_on_a_line(
    m: Float[Tensor, "*B"], s: Float[Tensor, "*B"], n: Float[Tensor, "*B"], t: Float[Tensor, "*B"]
) -> Float[Tensor, "*B"]:
    """TV of N(m, s) and N(n, t): half the differences of their masses between the points where p = q, summed.

    With y = (x - (m + n)/2) / max(s, t), u = 1/s^2 and v = 1/t^2 on that scale, log p/q = a y^2 + b y + c with

        a = (v - u)/2,   b = d (u + v),   c = a d^2 + log(u/v)/2,   d = (m - n) / 2 max(s, t).

    p - q is 0 at the roots, so that the mass has no derivative with respect to them: they are constants.
    """
    with torch.no_grad():
        centre, scale = (m + n) / 2, torch.maximum(s, t)
        d, u, v = (m - n) / (2 * scale), (scale / s).square(), (scale / t).square()
        a, b, log_uv = (v - u) / 2, d * (u + v), 2 * (t / s).log()
        c = a * d.square() + log_uv / 2
        # b^2 - 4 a c = 4 d^2 u v + (u - v) log(u/v), where nothing cancels; neither does it in k and the roots.
        k = -(b + torch.copysign((4 * d.square() * u * v + (u - v) * log_uv).clamp(min=0).sqrt(), b)) / 2
        roots = torch.stack([k / a, c / k]).nan_to_num(nan=0.0)
        reach = d.abs() + 40  # beyond it both masses are 0; a root there may be infinite
        low, high = (centre + scale * root.clamp(-reach, reach) for root in (roots.amin(0), roots.amax(0)))
    p_low, p_high, q_low, q_high = (
        torch.special.ndtr((x - mean) / std) for mean, std in ((m, s), (n, t)) for x in (low, high)
    )
    left, middle, right = p_low - q_low, (p_high - p_low) - (q_high - q_low), q_high - p_high
    return (left.abs() + middle.abs() + right.abs()) / 2


def _gaussian_tv_of_equal_stds(m: Tensor, s: Tensor, n: Tensor, t: Tensor) -> Tensor:
    """TV where s = t: P(A) - Q(A) = erf(|d| / 2 sqrt 2), d_i = (m_i - n_i)/s_i, A = {p > q} a half-space.

    A is a constant of the derivative, as on the line; s and t are not, so that the gradient is complete.
    """
    normal, centre = ((m - n) / s.square()).detach(), ((m + n) / 2).detach()
    apart = (normal != 0).any(-1)
    normal = torch.where(apart.unsqueeze(-1), normal, 1)
    in_p, in_q = (
        torch.special.ndtr((normal * (mean - centre)).sum(-1) / torch.linalg.vector_norm(normal * std, dim=-1))
        for mean, std in ((m, s), (n, t))
    )
    return torch.where(apart, in_p - in_q, 0)


# Between a Gaussian and a mixture of Gaussians.
def mixture_log_prob(
    logits: Float[Tensor, "*#B M"],
    means: Float[Tensor, "*#B M Da"],
    stds: Float[Tensor, "*#B M Da"],
    actions: Float[Tensor, "*#B Da"],
) -> Float[Tensor, "*#B"]:
    """log q(u) of q = sum_k w_k N(mean_k, std_k), w = softmax(logits)."""
    z = (actions.unsqueeze(-2) - means) / stds
    log_normal = (-z.square() / 2 - stds.log() - math.log(2 * math.pi) / 2).sum(-1)
    return (logits.log_softmax(-1) + log_normal).logsumexp(-1)


def monte_carlo_f_divergence(
    mean: Float[Tensor, "*B Da"],
    std: Float[Tensor, "*B Da"],
    logits: Float[Tensor, "*B M"],
    means: Float[Tensor, "*B M Da"],
    stds: Float[Tensor, "*B M Da"],
    *,
    kind: str,
    samples: int = SAMPLES // 4,
) -> Float[Tensor, "*B"]:
    """D_f(P || Q) of the expert P = N(mean, std) and a learner that is a mixture, by samples/2 nodes for each Gaussian.

    Which component an action comes from cannot be differentiated. So none is drawn: all are summed over,
    E_Q[g] = sum_k w_k E_k[g], which is sampling stratified by component, and is differentiable in w, too.

    chi2 is E_P[p/q] - 1 over the nodes of P. It can be trusted where p/q is bounded: where the stds of the learner are
    not smaller than the expert's.

    Raises `UnknownName` for a kind that does not exist.
    """
    _check_kind(kind)
    if kind == "chi2":
        return _expm1(mixture_renyi2(mean, std, logits, means, stds, samples=samples))
    under_p, under_q = torch.zeros_like(mean[..., 0]), torch.zeros_like(mean[..., 0])
    if kind != "reverse_kl":
        log_ratio, weights = _log_ratio_under_p(mean, std, logits, means, stds, samples)
        under_p = (log_ratio if kind == "kl" else _BOUNDED[kind](log_ratio)) @ weights
    if kind != "kl":
        log_ratio, weights = _log_ratio_under_q(mean, std, logits, means, stds, samples)
        of_components = (-log_ratio if kind == "reverse_kl" else _BOUNDED[kind](log_ratio)) @ weights
        under_q = (logits.softmax(-1) * of_components).sum(-1)
    return under_p + under_q if kind in ("kl", "reverse_kl") else (under_p + under_q) / 2


def mixture_renyi2(
    mean: Float[Tensor, "*B Da"],
    std: Float[Tensor, "*B Da"],
    logits: Float[Tensor, "*B M"],
    means: Float[Tensor, "*B M Da"],
    stds: Float[Tensor, "*B M Da"],
    *,
    samples: int = SAMPLES // 4,
) -> Float[Tensor, "*B"]:
    """log(1 + chi2) = log E_P[p/q] of an expert N(mean, std) and a mixture, over the nodes of P."""
    log_ratio, weights = _log_ratio_under_p(mean, std, logits, means, stds, samples)
    return (log_ratio + weights.log()).logsumexp(-1)


def _log_ratio_under_p(
    mean: Tensor, std: Tensor, logits: Tensor, means: Tensor, stds: Tensor, samples: int
) -> tuple[Float[Tensor, "*B n"], Float[Tensor, "n"]]:
    """log p/q at the nodes of P, and the weights of the nodes."""
    z, weights = _nodes(samples // 2, mean.shape[-1], mean)
    x = mean.unsqueeze(-2) + std.unsqueeze(-2) * z
    log_q = mixture_log_prob(logits.unsqueeze(-2), means.unsqueeze(-3), stds.unsqueeze(-3), x)
    return _log_normal(x, mean, std) - log_q, weights


def _log_ratio_under_q(
    mean: Tensor, std: Tensor, logits: Tensor, means: Tensor, stds: Tensor, samples: int
) -> tuple[Float[Tensor, "*B M n"], Float[Tensor, "n"]]:
    """log p/q at the nodes of each component of Q, and the weights of the nodes."""
    z, weights = _nodes(samples // 2, mean.shape[-1], mean)
    x = means.unsqueeze(-2) + stds.unsqueeze(-2) * z
    of_all = (logits[..., None, None, :], means[..., None, None, :, :], stds[..., None, None, :, :])
    return _log_normal(x, mean.unsqueeze(-2), std.unsqueeze(-2)) - mixture_log_prob(*of_all, x), weights


# What they share.
_BOUNDED: dict[str, Callable[[Tensor], Tensor]] = {
    "js": lambda r: (
        r.sigmoid() * (LOG_2 + functional.logsigmoid(r)) + (-r).sigmoid() * (LOG_2 + functional.logsigmoid(-r))
    ),
    "tv": lambda r: (r / 2).tanh().abs(),
    "hellinger2": lambda r: 1 - 1 / (r / 2).clamp(-40, 40).cosh(),
}
"""Kind to the function g of r = log p/q with D_f = E_M[g(r)], M = (P + Q)/2; p/2m = sigmoid(r)."""


def _log_normal(
    x: Float[Tensor, "*B n Da"], mean: Float[Tensor, "*#B Da"], std: Float[Tensor, "*#B Da"]
) -> Float[Tensor, "*B n"]:
    """log N(x; mean, std) at n points."""
    z = (x - mean.unsqueeze(-2)) / std.unsqueeze(-2)
    return -(z.square() / 2 + std.unsqueeze(-2).log() + math.log(2 * math.pi) / 2).sum(-1)


def _nodes(count: int, size: int, like: Tensor) -> tuple[Float[Tensor, "n Da"], Float[Tensor, "n"]]:
    """Nodes z and weights w, sum_j w_j g(z_j) ~ E[g(z)] for z ~ N(0, 1) in `size` components, typed as `like`."""
    z, weights = _standard_nodes(count, size)
    return z.to(like), weights.to(like)


@lru_cache(maxsize=64)
def _standard_nodes(count: int, size: int) -> tuple[Tensor, Tensor]:
    """In one component the trapezoidal rule, which converges exponentially here; in more, a scrambled Sobol sequence.

    The sequence is given mean 0 and variance 1, so that quadratic functions such as log p/q of Gaussians are exact
    but for their products between components.
    """
    if size == 1:
        z = torch.linspace(-7, 7, count, dtype=torch.float64)
        weights = (-z.square() / 2).exp()
        return z.unsqueeze(-1), weights / weights.sum()
    uniform = torch.quasirandom.SobolEngine(size, scramble=True, seed=0).draw(count, dtype=torch.float64)
    z = torch.special.ndtri(uniform.clamp(1e-9, 1 - 1e-9))
    z = (z - z.mean(0)) / z.std(0, correction=0)
    return z, torch.full((count,), 1 / count, dtype=torch.float64)


def _expm1(x: Tensor) -> Tensor:
    """exp(x) - 1, at most about the largest number of the type, where the gradient is 0."""
    return x.clamp(max=math.log(torch.finfo(x.dtype).max) - 1).expm1()


def _check_kind(kind: str) -> None:
    if kind not in KINDS:
        raise UnknownName("f-divergence", kind, KINDS)


def _same_shape(expert: Tensor, other: Tensor) -> None:
    if expert.shape != other.shape:
        raise InputError(
            f"shapes {tuple(expert.shape)} and {tuple(other.shape)} differ; a loss compares action by action, "
            "so give expert and learner the same batch and the same components"
        )
