"""Finite MDPs that are small enough to list all their trajectories and deterministic policies."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lfd.planning import TabularMDP


class Trajectory(NamedTuple):
    """Everything about one trajectory that does not depend on who acts."""

    states: tuple[int, ...]
    actions: tuple[int, ...]
    chance: float
    """p_0(x_0) prod_t p(x_{t+1} | x_t, u_t), without the state after the last action."""
    counts: np.ndarray
    """f(tau)."""


def random_mdp(
    seed: int, *, states: int = 3, actions: int = 2, features: int = 2, horizon: int = 3, discount: float = 0.9
) -> TabularMDP:
    """Random numbers; about a third of the transitions are impossible."""
    rng = np.random.default_rng(seed)
    chance = rng.dirichlet(np.ones(states), (states, actions)) * (rng.random((states, actions, states)) < 0.67)
    chance += 1e-3 * np.eye(states)[rng.integers(states, size=(states, actions))]
    return TabularMDP(
        transitions=chance / chance.sum(axis=2, keepdims=True),
        initial=rng.dirichlet(np.ones(states)),
        features=rng.normal(size=(states, actions, features)),
        horizon=horizon,
        discount=discount,
    )


def random_policy(mdp: TabularMDP, rng: np.random.Generator) -> np.ndarray:
    """Of shape (T, S, A)."""
    states, actions, _ = mdp.features.shape
    return rng.dirichlet(np.ones(actions), (mdp.horizon, states))


def trajectories(mdp: TabularMDP) -> list[Trajectory]:
    """All that can happen, x_0, u_0, ..., x_{T-1}, u_{T-1}; `mdp.transitions` must be dense."""
    states, actions, _ = mdp.features.shape
    found = []
    for xs in itertools.product(range(states), repeat=mdp.horizon):
        for us in itertools.product(range(actions), repeat=mdp.horizon):
            chance = mdp.initial[xs[0]]
            for t in range(mdp.horizon - 1):
                chance = chance * mdp.transitions[xs[t], us[t], xs[t + 1]]
            if chance > 0:
                counts = sum(mdp.discount**t * mdp.features[x, u] for t, (x, u) in enumerate(zip(xs, us, strict=True)))
                found.append(Trajectory(xs, us, float(chance), np.asarray(counts)))
    return found


def probability(trajectory: Trajectory, policy: np.ndarray) -> float:
    """Under a policy (T, S, A)."""
    taken = [policy[t, x, u] for t, (x, u) in enumerate(zip(trajectory.states, trajectory.actions, strict=True))]
    return trajectory.chance * float(np.prod(taken))


def deterministic_policies(mdp: TabularMDP) -> Iterator[np.ndarray]:
    """All of shape (T, S, A)."""
    states, actions, _ = mdp.features.shape
    for choice in itertools.product(range(actions), repeat=mdp.horizon * states):
        yield np.eye(actions)[np.reshape(choice, (mdp.horizon, states))]


def numerical_gradient(function, point: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Central differences."""
    return np.array([(function(point + d) - function(point - d)) / (2 * step) for d in step * np.eye(len(point))])
