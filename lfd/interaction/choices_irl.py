"""R_H of people from what they did: maximum entropy inverse RL over their choices (chapters 10.4, 10.6.2).

A person in situation t chose a_t of a scene's choices; R_H is linear in the weights that are learned, R_H(a) = r_0(a) -
theta . phi(a), with r_0 what is known of it, such as what a crash costs everybody:

    p(a | t, theta)   = exp(rationality R_H(a)) / sum_a' exp(rationality R_H(a'))
    l(theta)          = sum_t log p(a_t | t, theta)
    dl/dtheta         = rationality sum_t ( E_p[phi] - phi(a_t) )
    -d2l/dtheta2      = rationality^2 sum_t Cov_p[phi]

Where an episode leaves open what its person went for, c one of C intents with an l_c each, it is a mixture:

    L(theta)          = sum_episodes log 1/C sum_c exp l_c(theta) - 1/2 sum_k (theta_k / s_k)^2
    dL/dtheta         = sum_episodes sum_c q_c dl_c - theta / s^2,      q_c ~ exp l_c
    -d2L/dtheta2      = sum_episodes [ sum_c q_c (-d2l_c - dl_c dl_c^T) + dl dl^T ] + 1/s^2,    dl = sum_c q_c dl_c

(the last as in Louis 1982). The normaliser is a sum, so that nothing is approximated; the rationality is given, since
r_0 is known: it sets the scale of theta. All features are costs, theta >= 0. s is a wide prior, for weights of which
the situations tell nothing. Without open intents L is concave.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize

from lfd.core.errors import InputError


@dataclass(frozen=True)
class Choices:
    """What a person chose from and what they took, if they went for one thing."""

    known: Float[np.ndarray, "T A"]
    """r_0 of each choice."""
    features: Float[np.ndarray, "T A K"]
    """phi, summed over what each choice leads to."""
    chosen: Int[np.ndarray, "T"]
    """Which of them it was."""


Person = tuple[Choices, ...]
"""An episode: its choices for each intent c that it leaves open."""
Likelihood = tuple[float, Float[np.ndarray, "K"], Float[np.ndarray, "K K"]]
"""A log-likelihood [nat], its slope, and minus its Hessian."""


@dataclass(frozen=True, kw_only=True)
class LearnedTheta:
    """A maximum of L."""

    theta: Float[np.ndarray, "K"]
    covariance: Float[np.ndarray, "K K"]
    """Of Laplace's approximation: the inverse of -d2L/dtheta2."""
    converged: bool
    """Whether the slope vanishes, but for weights at 0."""


def log_likelihood(theta: Float[np.ndarray, "K"], choices: Choices, rationality: float) -> Likelihood:
    """l."""
    logits = rationality * (choices.known - choices.features @ theta)
    logs = logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)
    p, rows = np.exp(logs), np.arange(len(logs))
    mean = np.einsum("ta,tak->tk", p, choices.features)
    away = choices.features - mean[:, None]
    slope = rationality * (mean - choices.features[rows, choices.chosen]).sum(axis=0)
    information = rationality**2 * np.einsum("ta,tak,tal->kl", p, away, away)
    return float(logs[rows, choices.chosen].sum()), slope, information


def of_people(theta: Float[np.ndarray, "K"], people: Sequence[Person], rationality: float) -> Likelihood:
    """The sum over episodes of log 1/C sum_c exp l_c."""
    value, slope, information = 0.0, np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
    for person in people:
        each = [log_likelihood(theta, choices, rationality) for choices in person]
        values, slopes, curvatures = (np.array(part) for part in zip(*each, strict=True))
        total = float(np.logaddexp.reduce(values))
        q = np.exp(values - total)
        mean = q @ slopes
        value += total - np.log(len(person))
        slope += mean
        information += np.einsum("c,ckl->kl", q, curvatures) - np.einsum("c,ck,cl->kl", q, slopes, slopes)
        information += np.outer(mean, mean)
    return value, slope, information


def learn_theta(people: Sequence[Person], *, wide: Float[np.ndarray, "K"], rationality: float) -> LearnedTheta:
    """The theta >= 0 of highest L, s being `wide`, by L-BFGS-B in units of it.

    Raises `InputError` for no people, a rationality that is not positive and finite, or a maximum that is none.
    """
    if not people:
        raise InputError("no episode to learn from; give recordings of `lfd interact`")
    if not 0.0 < rationality < np.inf:
        raise InputError(f"rationality = {rationality}: give a finite number above 0")

    def loss(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope, _ = of_people(z * wide, people, rationality)
        return 0.5 * float(z @ z) - value, z - slope * wide

    choices = sum(len(person[0].chosen) for person in people)
    found = minimize(
        loss, np.zeros(len(wide)), jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * len(wide),
        options={"maxiter": 1000, "maxcor": 30, "gtol": 1e-6 * choices, "ftol": 1e-14},
    )  # fmt: skip
    theta = found.x * wide
    _, _, information = of_people(theta, people, rationality)
    information = information + np.diag(wide**-2.0)
    if np.linalg.eigvalsh(information).min() <= 0.0:
        raise InputError(f"{len(people)} episodes leave open what their people went for: give more of them")
    return LearnedTheta(theta=theta, covariance=np.linalg.inv(information), converged=bool(found.success))
