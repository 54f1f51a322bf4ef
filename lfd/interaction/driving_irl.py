"""R_H of people at the wheel from what they did: maximum entropy inverse RL over their choices (chapters 10.4, 10.6.2).

A person in situation t chose a_t of `ACCELERATIONS`; R_H is linear in theta, R_H(a) = r_0(a) - theta . phi(a), with r_0
what a crash costs everybody:

    p(a | t, theta) = exp(rationality R_H(a)) / sum_a' exp(rationality R_H(a'))
    L(theta)        = sum_t log p(a_t | t, theta) - 1/2 sum_k (theta_k / s_k)^2
    dL/dtheta       = rationality sum_t ( E_p[phi] - phi(a_t) ) - theta / s^2

L is concave. The normaliser is a sum, so that nothing is approximated; the rationality is given, since crashes have a
known weight: it sets the scale of theta. All features are costs, theta >= 0. s is a wide prior, for weights of which
the situations tell nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize

from lfd.core.episode import Episode
from lfd.core.errors import InputError
from lfd.interaction.driving_people import ACCELERATIONS, choice_rewards
from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, Car, DrivingScene, seen_cars

FEATURES = ("speed", "effort", "giving way", "standing")
"""Of R_H, in theta's order (`lfd.interaction.driving_model`)."""
WIDE = np.array([1.0, 5.0, 400.0, 400.0])
"""s: standard deviations of the prior."""
NEAR_M_S = 1e-6
"""Differences of speed from what an acceleration leads to that are rounding [m/s]."""


@dataclass(frozen=True)
class Choices:
    """What people chose from and what they took."""

    known: Float[np.ndarray, "T A"]
    """r_0 of each acceleration."""
    features: Float[np.ndarray, "T A K"]
    """phi, summed over what each acceleration leads to."""
    chosen: Int[np.ndarray, "T"]
    """Which of them it was."""


@dataclass(frozen=True, kw_only=True)
class LearnedTheta:
    """A maximum of L."""

    theta: Float[np.ndarray, "K"]
    covariance: Float[np.ndarray, "K K"]
    """Of Laplace's approximation: the inverse of -d2L/dtheta2."""
    converged: bool
    """Whether the slope vanishes, but for weights at 0."""


def choices_of(scene: DrivingScene, episode: Episode) -> Choices:
    """The choices of the person in a recorded episode.

    What the person did is told by their speed. Steps in which they come to a stop are left out: several accelerations
    lead there. Raises `InputError` for an episode whose person chose otherwise, or nothing.
    """
    rows = [
        seen_cars({name: values[t] for name, values in episode.observations.items()}) for t in range(len(episode) + 1)
    ]
    robots, people = zip(*rows, strict=True)
    speeds = np.array([person.speed for person in people])
    ends = speeds[:-1, None] + ACCELERATIONS.numpy() / episode.metadata.control_hz
    away = np.abs(ends - speeds[1:, None])
    moves = speeds[1:] > 0.0
    if not moves.any() or (away[moves].min(axis=1) > NEAR_M_S).any():
        raise InputError(
            "the episode's person did not choose from the accelerations that people have here; give recordings of "
            "`lfd interact`, in which they move"
        )
    robot = [torch.tensor([getattr(car, name) for car in robots[:-1]]) for name in ("x", "y", "yaw", "speed")]
    first = torch.from_numpy(np.clip(episode.actions, ACTION_LOW, ACTION_HIGH)).unbind(-1)
    start: Car = people[0]
    way = np.hypot(*np.array([[p.x - start.x, p.y - start.y] for p in people[:-1]]).T)
    person = start, torch.from_numpy(way), torch.from_numpy(speeds[:-1])
    units = torch.cat([torch.zeros(1, len(FEATURES)), torch.eye(len(FEATURES))]).double()
    x, y, yaw, speed = (values.double() for values in robot)
    rewards = choice_rewards(scene, units, (x, y, yaw, speed), person, (first[0], first[1])).numpy()
    known, with_one = rewards[:, 0], rewards[:, 1:]
    features = np.moveaxis(known[:, None] - with_one, 1, 2)
    return Choices(known[moves], features[moves], away[moves].argmin(axis=1))


def together(parts: Sequence[Choices]) -> Choices:
    """The choices of several episodes. Raises `InputError` for none."""
    if not parts:
        raise InputError("no episode to learn from; give recordings of `lfd interact`")
    known, features, chosen = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("known", "features", "chosen")
    )
    return Choices(known, features, chosen)


def log_likelihood(
    theta: Float[np.ndarray, "K"], choices: Choices, rationality: float
) -> tuple[float, Float[np.ndarray, "K"], Float[np.ndarray, "K K"]]:
    """sum_t log p(a_t | t, theta) [nat], its slope, and minus its Hessian: rationality^2 sum_t Cov_p[phi]."""
    logits = rationality * (choices.known - choices.features @ theta)
    logits -= logits.max(axis=1, keepdims=True)
    logs = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
    p, rows = np.exp(logs), np.arange(len(logs))
    mean = np.einsum("ta,tak->tk", p, choices.features)
    away = choices.features - mean[:, None]
    slope = rationality * (mean - choices.features[rows, choices.chosen]).sum(axis=0)
    information = rationality**2 * np.einsum("ta,tak,tal->kl", p, away, away)
    return float(logs[rows, choices.chosen].sum()), slope, information


def learn_theta(choices: Choices, *, rationality: float) -> LearnedTheta:
    """The theta >= 0 of highest L, by L-BFGS-B in units of the prior.

    Raises `InputError` for a rationality that is not positive and finite.
    """
    if not 0.0 < rationality < np.inf:
        raise InputError(f"rationality = {rationality}: give a finite number above 0")

    def loss(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope, _ = log_likelihood(z * WIDE, choices, rationality)
        return 0.5 * float(z @ z) - value, z - slope * WIDE

    found = minimize(
        loss, np.zeros(len(FEATURES)), jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * len(FEATURES),
        options={"maxiter": 1000, "maxcor": 30, "gtol": 1e-6 * len(choices.chosen), "ftol": 1e-14},
    )  # fmt: skip
    theta = found.x * WIDE
    _, _, information = log_likelihood(theta, choices, rationality)
    return LearnedTheta(
        theta=theta, covariance=np.linalg.inv(information + np.diag(WIDE**-2.0)), converged=bool(found.success)
    )
