"""Maximum entropy inverse RL for continuous trajectories, with a sampled partition function.

    p(tau) = exp(w^T f(tau)) / Z(w),   max_w  L(w) = w^T mean_i f(xi_i) - log Z(w) - l2/2 |w|^2

The distribution is the chapter's exp(w^T f) with respect to the measure d tau of the samples' densities (the first of
the three in `lfd.reward_learning.maxent_tabular`). If samples come from a stochastic world and their `log_densities`
hold the probabilities of actions alone, the dynamics cancel and it is the second, Ziebart 2008.

With trajectories tau_j drawn from a density q (self-normalised importance sampling):

    Z(w) ~ mean_j exp(w^T f_j) / q_j,   omega_j ~ exp(w^T f_j) / q_j, sum_j omega_j = 1,   E[f] ~ sum_j omega_j f_j,
    effective sample size  1 / sum_j omega_j^2

An effective sample size of a few means that E[f] is a guess, whatever its standard error says.

The loop is the chapter's: 1. initialise w; 2. plan for w; 3. sample and estimate E[f]; 4. a step on w; 5. repeat. The
step is Newton's on these samples, (Cov_omega[f] + l2 I)^-1 gradient, halved until they still represent the new w.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError
from lfd.rewards.checked_arrays import finite_array

DAMPING = 1e-9
"""Added to the covariance, as a share of each feature's variance, to make it definite."""


@dataclass(frozen=True)
class SampledTrajectories:
    """n trajectories that a planner drew."""

    features: Float[np.ndarray, "n K"]
    """f(tau_j)."""
    log_densities: Float[np.ndarray, "n"]
    """log q(tau_j), natural logarithm; what is left out alike for all shifts log Z."""


@dataclass(frozen=True)
class Partition:
    """What samples say about exp(w^T f) / Z(w)."""

    log_partition: float
    """log Z(w)."""
    shares: Float[np.ndarray, "n"]
    """omega_j, the probabilities of the samples."""
    mean: Float[np.ndarray, "K"]
    """E[f]."""
    standard_error: Float[np.ndarray, "K"]
    """sqrt(sum_j omega_j^2 (f_j - E[f])^2), the delta method's."""
    effective_sample_size: float
    """1 / sum_j omega_j^2, between 1 and n."""


@dataclass(frozen=True)
class MaxEntSampled:
    """Result of `maxent_sampled`; estimates are from the last samples."""

    weights: Float[np.ndarray, "K"]
    """w."""
    log_likelihood: float
    """w^T mean f - log Z(w): mean log density of the demonstrations."""
    feature_gap: Float[np.ndarray, "K"]
    """mean f - E[f]."""
    standard_error: Float[np.ndarray, "K"]
    """Of E[f]; a gap below it is noise."""
    effective_sample_size: float
    """Of the last samples at the last w."""
    gradient_norms: Float[np.ndarray, "iterations"]
    """|mean f - E[f] - l2 w|_2 of each iteration."""
    log_likelihoods: Float[np.ndarray, "iterations"]
    """Of each iteration."""
    effective_sample_sizes: Float[np.ndarray, "iterations"]
    """Of each iteration."""
    converged: bool
    """Whether the last gradient is no longer than the tolerance."""


def partition(weights: Float[np.ndarray, "K"], samples: SampledTrajectories) -> Partition:
    """Estimates of log Z(w) and E[f] from `samples`."""
    logits = samples.features @ weights - samples.log_densities
    largest = logits.max()
    total = float(largest + np.log(np.exp(logits - largest).sum()))
    shares = np.exp(logits - total)
    mean = shares @ samples.features
    return Partition(
        log_partition=total - float(np.log(len(logits))),
        shares=shares,
        mean=mean,
        standard_error=np.sqrt(shares**2 @ (samples.features - mean) ** 2),
        effective_sample_size=1.0 / float(shares @ shares),
    )


def fixed_pool(features: Shaped[np.ndarray, "..."]) -> Callable[[Float[np.ndarray, "K"]], SampledTrajectories]:
    """A planner that always returns the same n trajectories: p is then a softmax over them, and exact.

    The robust choice where densities are not known. The demonstrations should be among them: a mean outside the hull of
    the pool's `features` (n, K) has no weights.
    """
    pool = finite_array("features of the pool", features, ("n", "K"))
    samples = SampledTrajectories(pool, np.full(len(pool), -np.log(max(len(pool), 1))))
    return lambda _: samples


def maxent_sampled(
    demonstrations: Shaped[np.ndarray, "..."],
    plan: Callable[[Float[np.ndarray, "K"]], SampledTrajectories],
    *,
    initial: Shaped[np.ndarray, "..."],
    tolerance: float | int,
    max_iterations: int,
    least_share: float | int,
    l2: float | int = 0.0,
) -> MaxEntSampled:
    """Weights for `demonstrations`, their feature counts f(xi_i) (N, K), from `initial` (K,).

    `plan(weights)` returns trajectories sampled from a density that should be near exp(w^T f) / Z(w). A step is halved
    until at least `least_share`, in (0, 1), of the effective sample size remains at the new weights.

    Raises `InputError` for arrays of other shapes or without rows, numbers that are not finite, l2 < 0, and a feature
    that is the same in every demonstration and sample: they do not tell its weight.
    """
    counts = finite_array("demonstrations", demonstrations, ("N", "K"))
    weights = finite_array("initial", initial, (counts.shape[1],))
    _check(counts, l2, least_share, max_iterations)
    mean = counts.mean(axis=0)
    history: list[tuple[float, float, float]] = []
    while True:
        samples = _checked(plan(weights), counts)
        estimate = partition(weights, samples)
        gradient = mean - estimate.mean - l2 * weights
        likelihood = float(weights @ mean) - estimate.log_partition
        history.append((float(np.linalg.norm(gradient)), likelihood, estimate.effective_sample_size))
        if history[-1][0] <= tolerance or len(history) == max_iterations:
            break
        weights = weights + _step(gradient, l2, samples, estimate, least_share)
    norms, likelihoods, sizes = np.array(history).T
    return MaxEntSampled(
        weights=weights,
        log_likelihood=likelihood,
        feature_gap=mean - estimate.mean,
        standard_error=estimate.standard_error,
        effective_sample_size=estimate.effective_sample_size,
        gradient_norms=norms,
        log_likelihoods=likelihoods,
        effective_sample_sizes=sizes,
        converged=bool(norms[-1] <= tolerance),
    )


def _step(
    gradient: Float[np.ndarray, "K"],
    l2: float | int,
    samples: SampledTrajectories,
    estimate: Partition,
    least_share: float | int,
) -> Float[np.ndarray, "K"]:
    """Newton's step on these samples, halved until (sum_j omega_j r_j)^2 / sum_j omega_j r_j^2 >= least_share.

    r_j = exp(d^T f_j) is by how much the step d changes the weight of a sample; the ratio tends to 1 as d does to 0.
    """
    away = samples.features - estimate.mean
    covariance = (away * estimate.shares[:, None]).T @ away
    spread = (samples.features - samples.features.mean(axis=0)).var(axis=0)  # positive where one sample has all weight
    system = covariance + l2 * np.eye(len(gradient)) + DAMPING * np.diag(np.maximum(spread, np.finfo(float).tiny))
    step = np.linalg.lstsq(system, gradient, rcond=None)[0]
    while True:
        change = away @ step
        ratio = np.exp(change - change.max())
        if (estimate.shares @ ratio) ** 2 >= least_share * (estimate.shares @ ratio**2):
            return step
        step = step / 2


def _check(counts: Float[np.ndarray, "N K"], l2: float | int, least_share: float | int, max_iterations: int) -> None:
    if len(counts) == 0:
        raise InputError("demonstrations has no row: give the feature counts of at least one demonstration")
    if not 0.0 <= l2 < np.inf:
        raise InputError(f"l2 = {l2}: give a number that is not negative; 0 is no regulariser")
    if not 0.0 < least_share < 1.0:
        raise InputError(f"least_share = {least_share}: give a share of the effective sample size in (0, 1)")
    if max_iterations < 1:
        raise InputError(f"max_iterations = {max_iterations}: at least one is needed")


def _checked(samples: SampledTrajectories, counts: Float[np.ndarray, "N K"]) -> SampledTrajectories:
    features = finite_array("features of plan(weights)", samples.features, ("n", counts.shape[1]))
    densities = finite_array("log_densities of plan(weights)", samples.log_densities, (len(features),))
    if len(features) == 0:
        raise InputError("plan(weights) returned no trajectory: the partition function needs samples")
    constant = np.ptp(np.vstack([features, counts]), axis=0) == 0
    if constant.any():
        columns = ", ".join(str(int(k)) for k in np.flatnonzero(constant))
        raise InputError(
            f"feature {columns} is the same in every demonstration and sample: nothing tells its weight; leave it out"
        )
    return SampledTrajectories(features, densities)
