"""Maximum entropy inverse RL in a finite MDP, exact: maximum causal entropy.

    max_w  w^T mu_E - sum_s p_0(s) V_0(s; w) - l2/2 |w|^2,      gradient  mu_E - mu(pi_w) - l2 w

with soft values Q_t = w^T phi + gamma E[V_{t+1}], V_t = log sum_a exp Q_t, V_T = 0 and the policy pi_w = exp(Q - V).
Without l2 this is the expectation, over what the expert does, of sum_t gamma^t log pi_w,t(a_t | s_t): the terms
telescope. It is concave in w.

**Which distribution over trajectories.** The chapter's derivation of 10.7 and the papers behind it give three models,
equal only where dynamics are deterministic, gamma = 1 and the first state is given:

1. the chapter: p(tau) ~ exp(w^T f(tau)) over all trajectories that can happen. Dynamics decide only what is possible;
2. Ziebart et al. 2008: p(tau) ~ exp(w^T f(tau)) prod_t p(x_{t+1} | x_t, u_t). Dynamics weigh in, but so does luck: the
   model believes that a demonstrator can prefer the lucky outcome of a gamble;
3. maximum *causal* entropy (Ziebart, Bagnell, Dey 2010), **the one here**: a policy that knows at each time only what
   has happened so far. Outcomes have the probabilities of the dynamics whatever they are worth.

Example (T = 2, gamma = 1): in state 0, `safe` leads to state 1, `risky` to state 2 or 3 with probability 1/2 each; the
second decision, in whichever state, has two equal actions and earns w phi = 2 in state 3, else 0. Then `risky` has
probability

1. (1 + e^2) / (2 + e^2) = 0.893          each of the three outcomes counts fully
2. (1 + e^2) / (3 + e^2) = 0.807          and state 3 follows it with probability e^2 / (1 + e^2) = 0.881, not 1/2
3. e / (1 + e)           = 0.731          the gamble is worth its mean, 1, and state 3 follows it with probability 1/2

A mean of f over demonstrations that a policy in these dynamics produced is matched by the third model's policy; the
first two match it with distributions that no policy can produce.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError
from lfd.planning.bellman import discounted_visits, soft_backward
from lfd.planning.tabular_mdp import TabularMDP
from lfd.reward_learning.ascent import Objective, maximise
from lfd.rewards.checked_arrays import finite_array

CONSTANT = 1e-12
"""A feature whose values differ by no more than this share of their size is constant."""


@dataclass(frozen=True)
class MaxEnt:
    """Result of `maxent_tabular`."""

    weights: Float[np.ndarray, "K"]
    """w. Directions that demonstrations cannot tell stay 0 (`lfd.reward_learning.identifiable`)."""
    objective: float
    """What was maximised, the regulariser included."""
    gradient: Float[np.ndarray, "K"]
    """mu_E - mu - l2 w at the end."""
    mu: Float[np.ndarray, "K"]
    """mu(pi_w)."""
    policy: Float[np.ndarray, "T S A"]
    """pi_w."""
    converged: bool
    """Whether |gradient|_2 <= tolerance. It stays False where no policy has the expert's mu: the objective is then
    unbounded, and an l2 > 0 has a solution. For a deterministic expert it can be reached with very large weights."""
    log_likelihood: float
    """w^T mu_E - sum_s p_0(s) V_0(s): expectation of sum_t gamma^t log pi_w,t(a_t | s_t) over what the expert does."""
    feature_gap: Float[np.ndarray, "K"]
    """mu_E - mu."""
    iterations: int
    """Steps of L-BFGS."""


def maxent_tabular(
    mdp: TabularMDP,
    mu_expert: Shaped[np.ndarray, "..."],
    *,
    l2: float | int = 0.0,
    tolerance: float | int = 1e-8,
    max_iterations: int = 1000,
) -> MaxEnt:
    """Weights whose soft policy has the expert's feature expectation, by L-BFGS from w = 0.

    Raises `InputError` for a `mu_expert` of another size, a negative l2, and features that are constant over all states
    and actions: they add the same to every trajectory, so that no demonstration tells their weight.
    """
    expert = finite_array("mu_expert", mu_expert, (mdp.features.shape[2],))
    if not 0.0 <= l2 < np.inf:
        raise InputError(f"l2 = {l2}: give a number that is not negative; 0 is no regulariser")
    _refuse_constant_features(mdp)
    objective = _objective(mdp, expert, l2)
    found = maximise(objective, np.zeros_like(expert), tolerance=tolerance, max_iterations=max_iterations)
    weights = found.point
    policy = mdp.soft_solution(weights).policy
    gap = found.gradient + l2 * weights
    return MaxEnt(
        weights=weights,
        objective=found.value,
        gradient=found.gradient,
        mu=expert - gap,
        policy=policy,
        converged=found.converged,
        log_likelihood=found.value + 0.5 * l2 * float(weights @ weights),
        feature_gap=gap,
        iterations=found.iterations,
    )


def maxent_tabular_objective(
    mdp: TabularMDP, weights: Shaped[np.ndarray, "..."], mu_expert: Shaped[np.ndarray, "..."]
) -> tuple[float, Float[np.ndarray, "K"]]:
    """w^T mu_E - sum_s p_0(s) V_0(s; w) and its gradient mu_E - mu(pi_w).

    Raises `InputError` for weights or feature expectations of another size.
    """
    expert = finite_array("mu_expert", mu_expert, (mdp.features.shape[2],))
    return _objective(mdp, expert, 0.0)(finite_array("weights", weights, expert.shape))


def _objective(mdp: TabularMDP, expert: Float[np.ndarray, "K"], l2: float | int) -> Objective:
    """The objective and its gradient, in arrays that all evaluations share."""
    states, actions, _ = mdp.features.shape
    values, policy = np.empty((mdp.horizon + 1, states)), np.empty((mdp.horizon, actions, states))

    def value_and_gradient(weights: Float[np.ndarray, "K"]) -> tuple[float, Float[np.ndarray, "K"]]:
        soft_backward(mdp.dynamics, mdp.action_rewards(weights), mdp.discount, values, policy)
        visits = discounted_visits(mdp.dynamics, mdp.initial, policy, mdp.discount)
        value = weights @ expert - mdp.initial @ values[0] - 0.5 * l2 * (weights @ weights)
        return float(value), expert - visits.reshape(-1) @ mdp.feature_rows - l2 * weights

    return value_and_gradient


def _refuse_constant_features(mdp: TabularMDP) -> None:
    table = mdp.feature_rows
    constant = np.ptp(table, axis=0) <= CONSTANT * np.abs(table).max(axis=0)
    if constant.any():
        columns = [int(k) for k in np.flatnonzero(constant)]
        raise InputError(
            f"features[:, :, k] is constant for k = {', '.join(map(str, columns))}: it adds the same to every "
            "trajectory, so demonstrations do not tell its weight; leave it out"
        )
