"""Which weights demonstrations can tell: ambiguity of rewards, shown instead of hidden.

A direction u of weight space is not identifiable when adding it to w changes no probability. For exp(w^T f) over given
trajectories these are the u with u^T f(tau) the same for all of them. For the soft policy of a finite MDP they are the
null space of the Fisher information, minus the Hessian of maximum causal entropy's objective:

    F(w) = sum_t gamma^t sum_s d_t(s) Cov_{a ~ pi_t(. | s)}[grad Q_t(s, a)],
    grad Q_t(s,a) = phi(s,a) + gamma E[grad V_{t+1}(s')],   grad V_t(s) = sum_a pi_t(a | s) grad Q_t(s, a)

u^T F u = 0 says that u adds the same to all actions of every state that can be reached. That does not depend on w: the
null space is the same for all. Potentials that cancel, features that only the dynamics decide, and indicators that
always sum to 1 are there. The scale of w is identifiable only because the model fixes how rational the demonstrator is.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError
from lfd.planning.tabular_mdp import TabularMDP
from lfd.rewards.checked_arrays import finite_array

NEGLIGIBLE = 1e-10
"""Eigenvalues up to this count as 0, after each feature has been scaled to variance 1."""
ROUNDING = 1e-24
"""Variance, as a share of the mean square, up to which a feature is constant."""


@dataclass(frozen=True)
class Identifiable:
    """The directions of weight space that data tell, and those that they do not."""

    information: Float[np.ndarray, "K K"]
    """F, the inverse of the covariance of w that one trajectory allows (Cramer and Rao)."""
    identified: Float[np.ndarray, "R K"]
    """Orthonormal rows: what is told."""
    unidentified: Float[np.ndarray, "N K"]
    """Orthonormal rows: multiples of them can be added to w without any change in behaviour."""


def identifiable_directions(mdp: TabularMDP, weights: Shaped[np.ndarray, "..."]) -> Identifiable:
    """For the soft policies of `mdp`: the information at `weights` (K,), the directions of any weights.

    Directions are those of w = 0, where every action has the same probability: far from it a policy is so certain that
    rounding hides what could be told.
    """
    information, _ = _fisher(mdp, mdp.soft_solution(weights).policy)
    return _split(information, *_fisher(mdp, mdp.soft_solution(np.zeros(mdp.features.shape[2])).policy))


def _fisher(
    mdp: TabularMDP, policy: Float[np.ndarray, "T S A"]
) -> tuple[Float[np.ndarray, "K K"], Float[np.ndarray, "K"]]:
    """F, and the mean squares that its diagonal would be without centring."""
    states, actions, count = mdp.features.shape
    features, chances = mdp.feature_rows.reshape(actions, states, count), policy.transpose(0, 2, 1)
    at = mdp.occupancy(policy)
    slope, information, squares = np.zeros((states, count)), np.zeros((count, count)), np.zeros(count)
    for t in range(mdp.horizon - 1, -1, -1):
        of_actions = features + mdp.discount * mdp.dynamics.expected(slope)
        slope = np.einsum("as,ask->sk", chances[t], of_actions)
        away = (of_actions - slope).reshape(-1, count)
        share = mdp.discount**t * (chances[t] * at[t]).reshape(-1)
        information += (away * share[:, None]).T @ away
        squares += share @ of_actions.reshape(-1, count) ** 2
    return information, squares


def identifiable_from_counts(counts: Shaped[np.ndarray, "..."]) -> Identifiable:
    """For exp(w^T f) over given trajectories, all alike at w = 0; `counts` are their f (n, K), F their covariance.

    Raises `InputError` for fewer than two.
    """
    table = finite_array("counts", counts, ("n", "K"))
    if len(table) < 2:
        raise InputError(f"counts has {len(table)} rows: only differences between trajectories tell anything; give two")
    away = table - table.mean(axis=0)
    covariance = away.T @ away / len(table)
    return _split(covariance, covariance, (table**2).mean(axis=0))


def _split(
    information: Float[np.ndarray, "K K"], covariance: Float[np.ndarray, "K K"], squares: Float[np.ndarray, "K"]
) -> Identifiable:
    """Eigenvectors of `covariance` by whether their eigenvalue is negligible, where each feature's own is made 1.

    A feature whose own is a rounding error of its mean square, `squares`, is not told at all.
    """
    own = np.diag(covariance)
    varies = own > ROUNDING * squares
    unit = np.where(varies, 1.0 / np.sqrt(np.where(varies, own, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(covariance * np.outer(unit, unit))
    null = values <= NEGLIGIBLE
    basis = np.linalg.qr(np.where(varies, unit, 1.0)[:, None] * vectors[:, null], mode="complete")[0].T
    count = int(null.sum())
    return Identifiable(information=information, identified=basis[count:], unidentified=basis[:count])
