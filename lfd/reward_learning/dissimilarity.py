"""How unlike the expert's a policy is: margins m(pi*, pi) for maximum margin planning in a finite MDP.

Losses l_t(s, a) that the policy collects along its own way, m = E_pi[sum_t l_t(s_t, a_t)], can also be planned for
(`lfd.reward_learning.margin_loop`); the others serve for a given set of candidates.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Shaped

from lfd.planning.tabular_mdp import TabularMDP

Dissimilarity = Callable[[TabularMDP, Shaped[np.ndarray, "..."], Shaped[np.ndarray, "..."]], float]
SAME = 1e-12
"""Visits that differ by no more than this are the same."""


def unit(mdp: TabularMDP, expert: Shaped[np.ndarray, "..."], policy: Shaped[np.ndarray, "..."]) -> float:
    """1 where the two visit different states or act differently there, else 0."""
    return float(occupancy_distance(mdp, expert, policy) > SAME)


def feature_distance(mdp: TabularMDP, expert: Shaped[np.ndarray, "..."], policy: Shaped[np.ndarray, "..."]) -> float:
    """|mu(pi*) - mu(pi)|_2, in the features' units."""
    return float(np.linalg.norm(mdp.feature_expectation(expert) - mdp.feature_expectation(policy)))


def occupancy_distance(mdp: TabularMDP, expert: Shaped[np.ndarray, "..."], policy: Shaped[np.ndarray, "..."]) -> float:
    """1/(2T) sum_{t,s,a} |x*_t(s,a) - x_t(s,a)|, x_t(s,a) = d_t(s) pi_t(a | s): total variation, in [0, 1]."""
    return float(np.abs(_visits(mdp, expert) - _visits(mdp, policy)).sum() / (2 * mdp.horizon))


def action_difference(mdp: TabularMDP, expert: Shaped[np.ndarray, "..."], policy: Shaped[np.ndarray, "..."]) -> float:
    """Share of the policy's steps in which the expert would have acted otherwise, in [0, 1]."""
    return expected_loss(mdp, action_losses(mdp, expert), policy)


def unvisited_share(mdp: TabularMDP, expert: Shaped[np.ndarray, "..."], policy: Shaped[np.ndarray, "..."]) -> float:
    """Share of the policy's steps in states where the expert never is at that time, in [0, 1] (Ratliff 2006)."""
    return expected_loss(mdp, unvisited_losses(mdp, expert), policy)


DISSIMILARITIES: dict[str, Dissimilarity] = {
    "unit": unit,
    "features": feature_distance,
    "occupancy": occupancy_distance,
    "actions": action_difference,
    "unvisited": unvisited_share,
}


def action_losses(mdp: TabularMDP, expert: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "T S A"]:
    """l_t(s, a) = (1 - pi*_t(a | s)) / T."""
    return (1.0 - mdp.checked_policy(expert)) / mdp.horizon


def unvisited_losses(mdp: TabularMDP, expert: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "T S A"]:
    """l_t(s, a) = 1 / T where the expert is in s at time t with probability 0, else 0."""
    never = mdp.occupancy(expert)[:, :, None] == 0
    return np.broadcast_to(never / mdp.horizon, (*never.shape[:2], mdp.features.shape[1]))


def expected_loss(mdp: TabularMDP, losses: Float[np.ndarray, "T S A"], policy: Shaped[np.ndarray, "..."]) -> float:
    """E_pi[sum_t l_t(s_t, a_t)], not discounted."""
    return float((_visits(mdp, policy) * losses).sum())


def _visits(mdp: TabularMDP, policy: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "T S A"]:
    return mdp.occupancy(policy)[:, :, None] * mdp.checked_policy(policy)
