"""The tightrope: the smallest problem in which a cloned policy pays for an error until the end of the episode.

Ross, Bagnell 2010, "Efficient Reductions for Imitation Learning", and Ross, Gordon, Bagnell 2011. A walker is on a rope
or off it, and pays 1 for each step that ends off it. On the rope a gust comes with probability epsilon:

    on the rope    walk keeps the walker there without a gust, lean with one; anything else leads off
    off the rope   climb leads back; anything else does not

The expert sees the gust and never pays. The learner's class of policies does not see it, so that the best of the class
errs with probability epsilon on the rope, with however much data: an error that is learned, not one that is assumed.
Whether the learner climbs is a matter of whether its data show it off the rope. Everything is computed exactly, as
expectations: data are expected numbers of labels, costs are sums of probabilities.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

ROPE, OFF = range(2)
WALK, LEAN, CLIMB = range(3)
NEXT: Int[np.ndarray, "S G A"] = np.array(
    [[[ROPE, OFF, OFF], [OFF, ROPE, OFF]], [[OFF, OFF, ROPE], [OFF, OFF, ROPE]]], dtype=int
)
"""Where a place, the absence or presence of a gust, and an action lead."""
COST: Float[np.ndarray, "S"] = np.array([0.0, 1.0])
EXPERT: Float[np.ndarray, "S G A"] = np.eye(3)[[[WALK, LEAN], [CLIMB, CLIMB]]]
"""Probability of the expert's actions."""


def gusts(epsilon: float) -> Float[np.ndarray, "G"]:
    """Probability of no gust and of one."""
    return np.array([1.0 - epsilon, epsilon])


def mixture(learner: Float[np.ndarray, "S A"], beta: float) -> Float[np.ndarray, "S G A"]:
    """DAgger's pi_i = beta pi* + (1 - beta) pi_hat, with a coin in every step; the learner does not see the gust."""
    return beta * EXPERT + (1.0 - beta) * learner[:, None, :]


def transitions(policy: Float[np.ndarray, "S G A"], epsilon: float) -> Float[np.ndarray, "S S"]:
    """P_ss' = sum_g p(g) sum_a pi(a | s, g) 1[NEXT_sga = s']."""
    return np.einsum("g,sga,sgat->st", gusts(epsilon), policy, np.eye(2)[NEXT])


def visits(policy: Float[np.ndarray, "S G A"], epsilon: float, horizon: int) -> Float[np.ndarray, "T1 S"]:
    """Probability of each place before each step and at the end: d_0 P^t, from the rope."""
    matrix, at = transitions(policy, epsilon), [np.eye(2)[ROPE]]
    for _ in range(horizon):
        at.append(at[-1] @ matrix)
    return np.array(at)


def expected_labels(policy: Float[np.ndarray, "S G A"], epsilon: float, horizon: int) -> Float[np.ndarray, "S A"]:
    """Expected number of states in which the expert labels an action, in one episode that `policy` runs."""
    seen = visits(policy, epsilon, horizon)[:-1].sum(axis=0)
    return np.einsum("s,g,sga->sa", seen, gusts(epsilon), EXPERT)


def learn(labels: Float[np.ndarray, "S A"]) -> Float[np.ndarray, "S A"]:
    """The policy with the fewest wrong labels (0-1 loss) among those that see the place but not the gust.

    In a place without labels it does what was right most often elsewhere, as a function fitted elsewhere would.
    """
    there = np.where(labels.sum(axis=1, keepdims=True) > 0, labels, labels.sum(axis=0))
    return np.eye(3)[there.argmax(axis=1)]


def clone(epsilon: float, horizon: int) -> Float[np.ndarray, "S A"]:
    """Behaviour cloning: learn from the expert's own episodes."""
    return learn(expected_labels(EXPERT, epsilon, horizon))


def dagger(epsilon: float, horizon: int, betas: Sequence[float]) -> Float[np.ndarray, "S A"]:
    """Algorithm 1: a round for each beta, all labels together, the same `learn`."""
    labels = np.zeros((2, 3))
    learner = learn(labels)
    for beta in betas:
        labels += expected_labels(mixture(learner, beta), epsilon, horizon)
        learner = learn(labels)
    return learner


def expected_cost(policy: Float[np.ndarray, "S G A"], epsilon: float, horizon: int) -> float:
    """J_T = sum_t=1^T d_0 P^t c, what an episode of T steps costs."""
    return float((visits(policy, epsilon, horizon)[1:] @ COST).sum())


def error_rate(learner: Float[np.ndarray, "S A"], epsilon: float) -> float:
    """Probability of a wrong label on the rope, where the expert's episodes are: the theorem's epsilon."""
    return float(1.0 - np.einsum("g,ga,a->", gusts(epsilon), EXPERT[ROPE], learner[ROPE]))
