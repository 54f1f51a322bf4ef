"""What is known of a person's weights w from all evidence together: p(w) ~ the product of its factors.

    Lambda = sum P_i,   mu = Lambda^-1 (sum P_i m_i + sum d_push)         Gaussian and push factors: N(mu, Lambda^-1)
    w = mu + L^-T z,    Lambda = L L^T                                    whitened: z has no units
    log p(z) = -|z|^2 / 2 + sum_i (y_i x_i - log(1 + exp(x_i))) + const.  choices, y = 1 for a, 0 for b, 1/2 for equal
    x_i = rationality_i (w.d_i + o_i)

It is strictly concave, so the mode is found by Newton's method, and no matter in which order evidence came. A push
alone moves mu by Lambda^-1 d: `correction_update` with step size Lambda^-1. Without choices p is normal, and all of it
exact; with some, `covariance` is that of the Laplace approximation, and `sample` takes p as it is.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular
from scipy.special import expit

from lfd.core.errors import InputError
from lfd.reward_learning.slice_sampling import elliptical_steps
from lfd.rewards.factors import ChoiceFactor, Factor, GaussianFactor, PushFactor, check_size, factor_size
from lfd.rewards.reward_artifact import LinearReward

NEWTON_STEPS = 100
DECREMENT = 1e-18
"""Square of Newton's step, in units of the curvature, at which the mode is found."""
ROUNDS, STEPS = 8, 4
"""Rounds of slice steps before samples are handed out, and steps of each of two kinds in a round."""
NODES = 40
"""Of Gauss-Hermite quadrature for the consistency."""
HALF = 0.5
"""Spread of weights that came without one, as a share of their size."""


class WeightBelief:
    """p(w) from factors; immutable."""

    def __init__(self, factors: Iterable[Factor]):
        """Raises `InputError` for factors of different lengths, and where nothing Gaussian bounds all weights."""
        self.factors = tuple(factors)
        gaussians = [f for f in self.factors if isinstance(f, GaussianFactor)]
        if not gaussians:
            raise InputError(
                "this belief has no Gaussian factor, so that it has no end: begin with demonstrations, `lfd irl "
                "maxent`, or with weights and their spread, GaussianFactor(mean, precision)"
            )
        self._size = factor_size(gaussians[0])
        for number, factor in enumerate(self.factors):
            check_size(factor, [f"w_{k}" for k in range(self._size)], f"factor {number}")
        precision = np.sum([f.precision for f in gaussians], axis=0)
        pull = np.sum([f.precision @ f.mean for f in gaussians], axis=0)
        pull = pull + sum((f.difference for f in self.factors if isinstance(f, PushFactor)), np.zeros(self._size))
        try:
            self._lower = np.linalg.cholesky(0.5 * (precision + precision.T))
        except np.linalg.LinAlgError as error:
            raise InputError(
                "the Gaussian factors say nothing about some direction of the weights, so that the belief has no end: "
                "add weights with a spread, GaussianFactor(mean, precision)"
            ) from error
        self._mean = self._unwhitened(solve_triangular(self._lower, pull, lower=True))
        choices = [f for f in self.factors if isinstance(f, ChoiceFactor)]
        rationality = np.array([f.rationality for f in choices])
        differences = np.array([f.difference for f in choices]).reshape(-1, self._size)
        self._middle = rationality * (differences @ self._mean + np.array([f.offset for f in choices]))
        self._slopes = rationality[:, None] * solve_triangular(self._lower, differences.T, lower=True).T
        self._wins = np.array([{"a": 1.0, "b": 0.0, "equal": 0.5}[f.choice] for f in choices])

    def log_density(self, w: Float[np.ndarray, "M K"]) -> Float[np.ndarray, "M"]:
        """log p(w), up to a constant."""
        z = (np.asarray(w) - self._mean) @ self._lower
        return -0.5 * (z * z).sum(axis=1) + self._likelihood(z)

    @cached_property
    def mode(self) -> Float[np.ndarray, "K"]:
        """The most likely weights."""
        return self._mean + self._unwhitened(self._peak)

    @cached_property
    def covariance(self) -> Float[np.ndarray, "K K"]:
        """Of the Laplace approximation: the inverse curvature of -log p at the mode."""
        root = self._unwhitened(np.linalg.inv(np.linalg.cholesky(self._curvature(self._peak))).T)
        return root @ root.T

    @property
    def consistency(self) -> float:
        """Mean probability of what the person answered, over answers and the Laplace approximation; 1 without any.

        Near 1: weights explain the answers. Near 1/2: they look like guesses, or contradict each other. An "about
        equal" counts 1/2 at the most.
        """
        if not len(self._wins):
            return 1.0
        root = np.linalg.inv(np.linalg.cholesky(self._curvature(self._peak)))
        spread = np.linalg.norm(self._slopes @ root.T, axis=1)
        nodes, shares = np.polynomial.hermite_e.hermegauss(NODES)
        x = (self._middle + self._slopes @ self._peak)[:, None] + spread[:, None] * nodes
        chances = np.exp(self._wins[:, None] * x - np.logaddexp(0.0, x))
        return float(((chances @ shares) / shares.sum()).mean())

    def sample(self, n: int, rng: np.random.Generator) -> Float[np.ndarray, "n K"]:
        """`n` weights from p, each from a chain of its own. Raises `InputError` for fewer than 1.

        Chains begin at the Laplace approximation and move by elliptical slice steps, which leave p as it is: about
        N(mu, Lambda^-1), which is at home in the tails, and about the Laplace approximation, where most of p is.
        """
        if n < 1:
            raise InputError(f"n = {n}: ask for at least 1 sample")
        if not len(self._wins):
            return self._mean + self._unwhitened(rng.standard_normal((self._size, n))).T
        root = np.linalg.inv(np.linalg.cholesky(self._curvature(self._peak)))

        def beside(u: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "N"]:
            """log of p over the Laplace approximation, for z = peak + root^T u."""
            z = self._peak + u @ root
            return self._likelihood(z) - 0.5 * (z * z).sum(axis=1) + 0.5 * (u * u).sum(axis=1)

        u = rng.standard_normal((n, self._size))
        for _ in range(ROUNDS):
            u = elliptical_steps(u, beside(u), beside, STEPS, rng)
            z = self._peak + u @ root
            z = elliptical_steps(z, self._likelihood(z), self._likelihood, STEPS, rng)
            u = np.linalg.solve(root.T, (z - self._peak).T).T
        return self._mean + self._unwhitened((self._peak + u @ root).T).T

    def _unwhitened(self, z: Float[np.ndarray, "K ..."]) -> Float[np.ndarray, "K ..."]:
        """L^-T z."""
        return solve_triangular(self._lower, z, lower=True, trans=1)

    def _likelihood(self, z: Float[np.ndarray, "M K"]) -> Float[np.ndarray, "M"]:
        """log p of all answers."""
        x = self._middle + z @ self._slopes.T
        return (self._wins * x - np.logaddexp(0.0, x)).sum(axis=1)

    def _curvature(self, z: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K K"]:
        """Minus the Hessian of log p(z)."""
        chances = expit(self._middle + self._slopes @ z)
        return np.eye(self._size) + (self._slopes.T * (chances * (1.0 - chances))) @ self._slopes

    @cached_property
    def _peak(self) -> Float[np.ndarray, "K"]:
        """The mode as z, by Newton's method with halved steps: p falls off at least as a normal density does."""
        z = np.zeros(self._size)
        height = self._height(z)
        for _ in range(NEWTON_STEPS):
            gradient = self._slopes.T @ (self._wins - expit(self._middle + self._slopes @ z)) - z
            step = np.linalg.solve(self._curvature(z), gradient)
            gain = float(step @ gradient)
            if gain <= DECREMENT * (1.0 + float(z @ z)):
                return z
            length, tried = 1.0, self._height(z + step)
            while tried < height + 0.25 * length * gain and length * gain > 1e-12 * (1.0 + abs(height)):
                length *= 0.5
                tried = self._height(z + length * step)
            z, height = z + length * step, tried
        raise AssertionError("Newton's method did not end on a strictly concave density")

    def _height(self, z: Float[np.ndarray, "K"]) -> float:
        return float(self._likelihood(z[None])[0] - 0.5 * z @ z)


def weights_about(weights: Float[np.ndarray, "K"], ranges: Float[np.ndarray, "K"]) -> GaussianFactor:
    """A belief about weights that came without a spread: from a person, or a method without a likelihood.

        sigma_k = max(1, (|u_k| + rms(u)) / 2) / range_k,         u_k = w_k range_k

    A weight is taken to be right to half its size, and so that one of 0 can still become one, to half of what is usual
    among the others, in units of ranges. At least 1/range_k: a smaller weight makes less than one nat of a difference
    between two trajectories, which nobody's choices tell.
    """
    per_range = np.abs(weights * ranges)
    usual = np.sqrt((per_range**2).mean())
    spread = np.maximum(1.0, HALF * (per_range + usual)) / ranges
    return GaussianFactor(weights, np.diag(spread**-2.0))


def belief_of(reward: LinearReward) -> WeightBelief:
    """The belief that a reward's history amounts to.

    A change without a factor forgets what was known before: its weights are begun from anew, see `weights_about`.
    """
    factors: list[Factor] = []
    for change in reward.begun().history:
        if change.factor is None:
            factors = [weights_about(np.array(change.after), reward.ranges)]
        else:
            factors.append(change.factor)
    return WeightBelief(factors)


def updated(reward: LinearReward, factor: Factor, evidence: str) -> LinearReward:
    """The reward after some evidence: the mode of the belief, the Laplace approximation's covariance, a longer history.

    `evidence` says in words what was learned from. Raises `InputError` for a factor of another number of features.
    """
    check_size(factor, reward.features, evidence)
    belief = WeightBelief([*belief_of(reward).factors, factor])
    return reward.changed(belief.mode, evidence, factor, covariance=belief.covariance)


def undone(reward: LinearReward) -> LinearReward:
    """The reward without its last change. Raises `InputError` when there is none to undo."""
    before = reward.undone()
    if before.history[-1].factor is None:
        return before
    return replace(before, covariance=belief_of(before).covariance)
