"""The three methods of inverse RL on the same demonstrations in a finite MDP, for `lfd bench irl`.

All of them compare with policies that start where the demonstrations did, not with those that start from p_0: where a
demonstration begins says nothing about the reward, and with few of them would be most of the noise in mu_E.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from lfd.bench.irl_problems import uniform_policy
from lfd.planning import StatesAndActions, TabularMDP, expectation_of_demonstrations
from lfd.reward_learning import (
    MaxEnt,
    apprenticeship,
    loss_augmented_planner,
    max_margin_planning_loop,
    maxent_tabular,
)
from lfd.rewards.feature_counts import FeatureExpectations

APPRENTICESHIP, MARGIN, ENTROPY = "apprenticeship", "max margin planning", "maximum entropy"
ITERATIONS = 100
"""Plans that each of the first two methods may make."""
CLOSE = 0.01
"""epsilon of Algorithm 2 [feature counts]."""
SLACK_WEIGHT = 10.0
"""C of 10.6, for margins between 0 and 1."""
VIOLATION = 0.01
"""Tolerance of maximum margin planning, in the same unit."""
PRIOR = 1.0
"""Standard deviation of the weights [nat] that maximum entropy expects: l2 = 1 / (n PRIOR^2) for n demonstrations."""
GRADIENT = 1e-4
"""Tolerance of maximum entropy [feature counts]."""


@dataclass(frozen=True, eq=False)
class Learned:
    """What a method made of demonstrations."""

    weights: Float[np.ndarray, "K"]
    """w."""
    shares: Float[np.ndarray, "P"]
    """Probabilities with which it would draw one of `policies` for an episode."""
    policies: Callable[[], Sequence[Float[np.ndarray, "T S A"]]]
    """Makes the P policies that it hands over: mixture, optimal or soft policy."""
    seconds: float
    """CPU time of learning [s]."""
    converged: bool


@dataclass(frozen=True, eq=False)
class Evidence:
    """Demonstrations as the methods take them."""

    mdp: TabularMDP
    """The problem, starting where the demonstrations did."""
    expected: FeatureExpectations
    """mu_E."""
    shown: StatesAndActions


def evidence_of(mdp: TabularMDP, shown: StatesAndActions) -> Evidence:
    """Demonstrations in `mdp`."""
    starts = np.bincount(shown.states[:, 0], minlength=len(mdp.initial)) / len(shown.states)
    expected = expectation_of_demonstrations(mdp, pairs(shown))
    return Evidence(replace(mdp, initial=starts), expected, shown)


def pairs(shown: StatesAndActions) -> list[tuple[Int[np.ndarray, "T1"], Int[np.ndarray, "T"]]]:
    """Each demonstration's states and actions."""
    return list(zip(shown.states, shown.actions, strict=True))


def learn(name: str, evidence: Evidence) -> Learned:
    """Learn by one of `METHODS`; mu_E is there before the clock starts."""
    began = time.process_time()
    weights, shares, policies, converged = METHODS[name](evidence)
    return Learned(weights, shares, policies, time.process_time() - began, converged)


def demonstrated_losses(mdp: TabularMDP, shown: StatesAndActions) -> Float[np.ndarray, "T S A"]:
    """l(s, a) = (1 - n(s, a) / n(s)) / T with the demonstrated counts n, and 0 in states that no demonstration saw.

    m(pi*, pi) is then the expected share of steps in which the demonstrator is known to act otherwise.
    """
    states, actions, _ = mdp.features.shape
    counts: Int[np.ndarray, "S A"] = np.zeros((states, actions), dtype=np.intp)
    np.add.at(counts, (shown.states[:, :-1], shown.actions), 1)
    seen = counts.sum(axis=1, keepdims=True)
    losses = np.where(seen > 0, 1.0 - counts / np.maximum(seen, 1), 0.0) / mdp.horizon
    return np.broadcast_to(losses, (mdp.horizon, states, actions))


Answer = tuple[Float[np.ndarray, "K"], Float[np.ndarray, "P"], Callable[[], Sequence[np.ndarray]], bool]


def _apprenticeship(evidence: Evidence) -> Answer:
    mdp = evidence.mdp
    found = apprenticeship(
        evidence.expected.mean,
        lambda weights: mdp.feature_expectation(mdp.optimal_solution(weights).policy),
        initial=mdp.feature_expectation(uniform_policy(mdp)),
        tolerance=CLOSE,
        max_iterations=ITERATIONS,
    )
    used = np.flatnonzero(found.mixture)

    def policies() -> list[np.ndarray]:
        first = np.broadcast_to(uniform_policy(mdp), (mdp.horizon, *mdp.features.shape[:2]))
        return [first if i == 0 else mdp.optimal_solution(found.planned_for[i - 1]).policy for i in used]

    return found.weights, found.mixture[used], policies, found.converged


def _margin(evidence: Evidence) -> Answer:
    mdp = evidence.mdp
    found = max_margin_planning_loop(
        evidence.expected.mean,
        loss_augmented_planner(mdp, demonstrated_losses(mdp, evidence.shown)),
        slack_weight=SLACK_WEIGHT,
        tolerance=VIOLATION,
        max_iterations=ITERATIONS,
    )
    return found.weights, np.ones(1), lambda: [mdp.optimal_solution(found.weights).policy], found.converged


def _entropy(evidence: Evidence) -> Answer:
    found = maxent(evidence, tolerance=GRADIENT)
    return found.weights, np.ones(1), lambda: [found.policy], found.converged


def maxent(evidence: Evidence, *, tolerance: float) -> MaxEnt:
    """Maximum entropy with the prior."""
    l2 = 1.0 / (evidence.expected.trajectories * PRIOR**2)
    return maxent_tabular(evidence.mdp, evidence.expected.mean, l2=l2, tolerance=tolerance)


METHODS: dict[str, Callable[[Evidence], Answer]] = {
    APPRENTICESHIP: _apprenticeship,
    MARGIN: _margin,
    ENTROPY: _entropy,
}
