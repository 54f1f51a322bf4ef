"""The posterior over reward weights, from answers to "which of these two do you like better?" (chapter 10.5.1).

    p(w | answers) ~ p(w) prod_i p(answer_i | w)             with the choice models of `lfd.reward_learning.choices`

The prior is uniform on the unit sphere or in the unit ball. On the sphere |w| = 1 is fixed: the scale of w and the
rationality are not separately identifiable, only their product is.

Samples come from a particle filter whose particles are moved by elliptical slice sampling. Both priors are maps of
Gaussian vectors, so that neither has a step size: w = z / |z| is uniform on the sphere, and with a further coordinate
w = z / |z| Phi(z_K+1)^(1/K) is uniform in the ball.
"""

from typing import Literal, Self, get_args

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from lfd.core.errors import InputError, UnknownName
from lfd.reward_learning.choices import LIKELIHOODS, Likelihood, log_likelihood
from lfd.reward_learning.slice_sampling import elliptical_steps
from lfd.rewards.checked_arrays import finite_array
from lfd.rewards.factors import CHOICES, Choice

Prior = Literal["sphere", "ball"]
PARTICLES = 1024
MOVES = 10
"""Slice steps after each answer, and between samples that are handed out together."""
VIOLATED = -40.0
"""Least log likelihood of an answer while sampling. Where hard answers contradict each other, samples then violate as
few as possible; for the other models it is met nowhere near the posterior."""


class PreferencePosterior:
    """What is known of w; each answer narrows it down, or, where it contradicts others, widens it.

    Answers arrive by `update`. The same `rng` and calls give the same samples.
    """

    def __init__(
        self,
        n_features: int,
        *,
        rationality: float,
        prior: Prior,
        likelihood: Likelihood = "bradley_terry",
        rng: np.random.Generator,
    ):
        """`rationality` is the factor on w.(f_A - f_B); the larger, the fewer mistakes the person makes.

        Raises `InputError` for no features or a rationality that is not positive, `UnknownName` for other names.
        """
        if n_features < 1:
            raise InputError(f"n_features = {n_features}: weights need at least 1 feature")
        if not (np.isfinite(rationality) and rationality > 0.0):
            raise InputError(f"rationality = {rationality}: give a positive number; 0 would be a person who guesses")
        if prior not in get_args(Prior):
            raise UnknownName("prior", prior, get_args(Prior))
        if likelihood not in LIKELIHOODS:
            raise UnknownName("likelihood", likelihood, LIKELIHOODS)
        self._size, self._rationality, self._prior = n_features, rationality, prior
        self._kind: Likelihood = likelihood
        self._rng = rng
        self._differences, self._is_even = np.empty((0, n_features)), np.empty(0, dtype=bool)
        self._states = rng.standard_normal((PARTICLES, n_features + (prior == "ball")))
        self._filtered = 0
        self._mean: np.ndarray | None = None

    def __len__(self) -> int:
        """The number of answers so far."""
        return len(self._is_even)

    def update(self, f_a: Float[np.ndarray, "K"], f_b: Float[np.ndarray, "K"], choice: Choice) -> Self:
        """Take an answer in: the person prefers `a`, `b`, or finds them about `equal`.

        Raises `InputError` for features of another length, not finite, or equal (a trajectory is not compared with
        itself), `UnknownName` for another choice.
        """
        if choice not in CHOICES:
            raise UnknownName("choice", choice, CHOICES)
        f_a, f_b = (finite_array(name, f, (self._size,)) for name, f in (("f_a", f_a), ("f_b", f_b)))
        if (f_a == f_b).all():
            raise InputError(
                "f_a equals f_b: a trajectory compared with itself says nothing about w; ask for another pair"
            )
        towards = (
            f_b - f_a if choice == "b" else f_a - f_b
        )  # preferring b to a is preferring a to b the other way round
        self._differences = np.vstack([self._differences, towards])
        self._is_even = np.append(self._is_even, choice == "equal")
        self._mean = None
        return self

    def log_density(self, w: Float[np.ndarray, "M K"]) -> Float[np.ndarray, "M"]:
        """The unnormalised log posterior at some weights; -inf outside the prior's sphere (to 1e-6) or ball."""
        w = finite_array("w", w, ("M", self._size))
        norms = np.linalg.norm(w, axis=1)
        inside = np.abs(norms - 1.0) < 1e-6 if self._prior == "sphere" else norms <= 1.0 + 1e-12
        return np.where(inside, self._each(w, len(self)).sum(axis=0), -np.inf)

    def sample(self, n: int) -> Float[np.ndarray, "n K"]:
        """`n` weights from the posterior. Raises `InputError` for fewer than 1."""
        if n < 1:
            raise InputError(f"n = {n}: ask for at least 1 sample")
        rounds = []
        while len(rounds) * PARTICLES < n:
            self._advance()
            rounds.append(self._weights(self._states))
        return np.concatenate(rounds)[self._rng.permutation(len(rounds) * PARTICLES)[:n]]

    @property
    def mean(self) -> Float[np.ndarray, "K"]:
        """E[w], from samples; on the sphere its length says how sure w is."""
        if self._mean is None:
            self._mean = np.asarray(self.sample(4 * PARTICLES).mean(axis=0))
        return self._mean

    @property
    def consistency(self) -> float:
        """Mean probability, over posterior and answers, of what the person answered; 1 when nobody was asked yet.

        Near 1: w explains the answers. Near 1/2: they look like guesses, or contradict each other. An "about equal"
        counts 1/2 at the most.
        """
        if not len(self):
            return 1.0
        return float(np.exp(self._each(self.sample(PARTICLES), len(self))).mean())

    def _weights(self, states: Float[np.ndarray, "C D"]) -> Float[np.ndarray, "C K"]:
        """The prior's map from Gaussian vectors to weights."""
        direction = states[:, : self._size]
        weights = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        if self._prior == "ball":
            weights = weights * ndtr(states[:, -1:]) ** (1.0 / self._size)
        return weights

    def _each(self, weights: Float[np.ndarray, "C K"], count: int) -> Float[np.ndarray, "N C"]:
        """log p of each of the first `count` answers."""
        x = self._rationality * (self._differences[:count] @ weights.T)
        rows = log_likelihood(self._kind, x, "a")
        even = self._is_even[:count]
        rows[even] = log_likelihood(self._kind, x[even], "equal")
        return rows

    def _bounded(self, states: Float[np.ndarray, "C D"], count: int) -> Float[np.ndarray, "C"]:
        """The log likelihood that is sampled: finite, also where hard answers are violated."""
        return np.maximum(self._each(self._weights(states), count), VIOLATED).sum(axis=0)

    def _advance(self) -> None:
        """Take new answers in one by one: reweight, resample, move. Where there are none, move on."""
        if self._filtered == len(self):
            self._move(len(self))
        for count in range(self._filtered + 1, len(self) + 1):
            gain = self._bounded(self._states, count) - self._bounded(self._states, count - 1)
            chances = np.exp(gain - gain.max())
            self._states = self._states[_systematic(chances / chances.sum(), self._rng)]
            self._move(count)
        self._filtered = len(self)

    def _move(self, count: int) -> None:
        def target(states: np.ndarray) -> np.ndarray:
            return self._bounded(states, count)

        self._states = elliptical_steps(self._states, target(self._states), target, MOVES, self._rng)


def _systematic(chances: Float[np.ndarray, "C"], rng: np.random.Generator) -> np.ndarray:
    """Indices of particles, each as often as its chance says, by one random offset (Kitagawa 1996)."""
    places = (np.arange(len(chances)) + rng.random()) / len(chances)
    return np.minimum(np.searchsorted(np.cumsum(chances), places), len(chances) - 1)
