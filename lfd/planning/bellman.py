"""The recursions of a finite MDP over T decisions: backward for values and policies, forward for states.

Inside this module a policy has shape (T, A, S) and a reward (A, S), or (T, A, S) if it changes with time; see
`lfd.planning.dynamics` for why actions come first.
"""

import numpy as np
from jaxtyping import Float

from lfd.planning.dynamics import Dynamics


def soft_backward(
    dynamics: Dynamics,
    reward: Float[np.ndarray, "A S"],
    discount: float | int,
    values: Float[np.ndarray, "T1 S"],
    policy: Float[np.ndarray, "T A S"],
) -> None:
    """Soft value iteration into `values` and `policy` (Ziebart 2010, maximum causal entropy).

    Q_t(s,a) = r(s,a) + gamma E[V_{t+1}(s') | s,a],  V_t(s) = log sum_a exp Q_t(s,a),  V_T = 0,
    pi_t(a | s) = exp(Q_t(s,a) - V_t(s))

    The largest Q is subtracted before the exponential: no overflow however large the reward.
    """
    values[-1] = 0.0
    largest, total = np.empty(dynamics.states), np.empty(dynamics.states)
    for t in range(len(policy) - 1, -1, -1):
        q = policy[t]  # becomes the policy in place: no temporary of its size
        np.multiply(dynamics.expected(values[t + 1]), discount, out=q)
        q += reward
        np.max(q, axis=0, out=largest)
        q -= largest
        np.exp(q, out=q)
        np.sum(q, axis=0, out=total)
        q /= total
        np.log(total, out=values[t])
        values[t] += largest


def optimal_backward(
    dynamics: Dynamics, reward: Float[np.ndarray, "*times A S"], discount: float | int, horizon: int
) -> tuple[Float[np.ndarray, "T1 S"], Float[np.ndarray, "T A S"]]:
    """Value iteration: V_t(s) = max_a r(s,a) + gamma E[V_{t+1}(s') | s,a], V_T = 0.

    The policy is deterministic; of equally good actions it takes the first.
    """
    rewards = np.broadcast_to(reward, (horizon, dynamics.actions, dynamics.states))
    values = np.zeros((horizon + 1, dynamics.states))
    policy = np.zeros((horizon, dynamics.actions, dynamics.states))
    every = np.arange(dynamics.states)
    for t in range(horizon - 1, -1, -1):
        q = dynamics.expected(values[t + 1])
        q *= discount
        q += rewards[t]
        best = q.argmax(axis=0)
        values[t] = q[best, every]
        policy[t, best, every] = 1.0
    return values, policy


def occupancies(
    dynamics: Dynamics, initial: Float[np.ndarray, "S"], policy: Float[np.ndarray, "T A S"]
) -> Float[np.ndarray, "T S"]:
    """d_0 = p_0, d_{t+1}(s') = sum_{s,a} d_t(s) pi_t(a | s) p(s' | s,a)."""
    at = np.empty((len(policy), dynamics.states))
    at[0] = initial
    for t in range(len(policy) - 1):
        at[t + 1] = dynamics.moved(policy[t] * at[t])
    return at


def discounted_visits(
    dynamics: Dynamics, initial: Float[np.ndarray, "S"], policy: Float[np.ndarray, "T A S"], discount: float | int
) -> Float[np.ndarray, "A S"]:
    """sum_t gamma^t d_t(s) pi_t(a | s): mu(pi) is its product with the features."""
    at, weight = initial, 1.0
    visits = np.zeros((dynamics.actions, dynamics.states))
    now, weighted = np.empty_like(visits), np.empty_like(visits)
    for t in range(len(policy)):
        np.multiply(policy[t], at, out=now)
        np.multiply(now, weight, out=weighted)
        visits += weighted
        weight *= discount
        if t + 1 < len(policy):
            at = dynamics.moved(now)
    return visits
