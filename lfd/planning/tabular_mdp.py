"""A finite Markov decision process with T decisions, a reward linear in features, and its exact solutions."""

import operator
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int, Shaped

from lfd.core.errors import InputError
from lfd.planning.bellman import discounted_visits, occupancies, optimal_backward, soft_backward
from lfd.planning.dynamics import SUM_TOLERANCE, Dynamics, make_dynamics
from lfd.rewards.checked_arrays import checked_discount, finite_array


@dataclass(frozen=True, eq=False)
class Solution:
    """Values and policy of each time step; unpacks as `values, policy`."""

    values: Float[np.ndarray, "T1 S"]
    """V_t(s) = E[sum_{k>=t} gamma^(k-t) ... | s_t = s], zero in the last row."""
    policy: Float[np.ndarray, "T S A"]
    """pi_t(a | s)."""

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.values, self.policy))


@dataclass(frozen=True, eq=False)
class StatesAndActions:
    """n trajectories of T decisions; unpacks as `states, actions`."""

    states: Int[np.ndarray, "n T1"]
    """The last column is the state after the last action."""
    actions: Int[np.ndarray, "n T"]

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.states, self.actions))


@dataclass(frozen=True, kw_only=True, eq=False)
class TabularMDP:
    """S states, A actions, K features, T decisions; validated when made, arrays are read-only copies.

    Policies are probabilities of shape (T, S, A), or (S, A) for a stationary one. Every expectation starts from
    `initial`. Raises `InputError` naming state and action for transitions that are no probabilities, for features that
    are not finite, for tables whose sizes differ and for a discount outside [0, 1]; methods raise it for weights and
    policies of other sizes and for policies that are no probabilities.
    """

    transitions: Any
    """p(s' | s, a): dense (S, A, S), or a scipy.sparse matrix (S A, S) whose row s A + a is p(. | s, a)."""
    initial: Shaped[np.ndarray, "..."]
    """p_0(s), shape (S,)."""
    features: Shaped[np.ndarray, "..."]
    """phi(s, a), shape (S, A, K)."""
    horizon: int
    """Number of decisions T."""
    discount: float | int
    """gamma in [0, 1]."""

    def __post_init__(self) -> None:
        features = finite_array("features", self.features, ("S", "A", "K")).copy()
        sparse = sp.issparse(self.transitions)
        transitions: Any = (sp.csr_array if sparse else np.array)(self.transitions, dtype=np.float64, copy=True)
        states = transitions.shape[-1] if transitions.ndim else 0
        if len(features) != states:
            raise InputError(f"features have {len(features)} states, transitions have {states}: give (S, A, K) tables")
        initial = finite_array("initial", self.initial, (states,)).copy()
        for array in (features, initial, transitions.data if sparse else transitions):
            array.flags.writeable = False
        for name, value in (("transitions", transitions), ("initial", initial), ("features", features)):
            object.__setattr__(self, name, value)
        _check_distributions(initial, "initial", ())
        if operator.index(self.horizon) < 1:
            raise InputError(f"horizon = {self.horizon}: give the number of decisions, at least 1")
        checked_discount(self.discount)
        assert self.dynamics.states == states  # made here, so that wrong transitions are refused here

    @cached_property
    def dynamics(self) -> Dynamics:
        """The transitions as the recursions of `lfd.planning.bellman` take them."""
        return make_dynamics(self.transitions, self.features.shape[1])

    @cached_property
    def feature_rows(self) -> Float[np.ndarray, "AS K"]:
        """phi(s, a) in row a S + s."""
        return np.ascontiguousarray(self.features.transpose(1, 0, 2)).reshape(-1, self.features.shape[2])

    def reward(self, weights: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "S A"]:
        """w^T phi(s, a)."""
        return self.action_rewards(weights).T

    def action_rewards(self, weights: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "A S"]:
        """w^T phi(s, a), actions first."""
        states, actions, features = self.features.shape
        return (self.feature_rows @ finite_array("weights", weights, (features,))).reshape(actions, states)

    def soft_solution(self, weights: Shaped[np.ndarray, "..."]) -> Solution:
        """Maximum causal entropy: Q = w^T phi + gamma E[V'], V = log sum_a exp Q, V_T = 0, pi = exp(Q - V)."""
        states, actions, _ = self.features.shape
        values, policy = np.empty((self.horizon + 1, states)), np.empty((self.horizon, actions, states))
        soft_backward(self.dynamics, self.action_rewards(weights), self.discount, values, policy)
        return Solution(values, policy.transpose(0, 2, 1))

    def optimal_solution(self, weights: Shaped[np.ndarray, "..."]) -> Solution:
        """Q = w^T phi + gamma E[V'], V = max_a Q, V_T = 0; of equally good actions the policy takes the first."""
        values, policy = optimal_backward(self.dynamics, self.action_rewards(weights), self.discount, self.horizon)
        return Solution(values, policy.transpose(0, 2, 1))

    def optimal_for(self, rewards: Shaped[np.ndarray, "..."]) -> Solution:
        """The solution for rewards (T, S, A) of each time step, whose plain sum counts: gamma is part of them."""
        states, actions, _ = self.features.shape
        table = finite_array("rewards", rewards, (self.horizon, states, actions))
        values, policy = optimal_backward(self.dynamics, table.transpose(0, 2, 1), 1.0, self.horizon)
        return Solution(values, policy.transpose(0, 2, 1))

    def occupancy(self, policy: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "T S"]:
        """d_t(s), the probability of each state at each decision (not discounted)."""
        return occupancies(self.dynamics, self.initial, self._actions_first(policy))

    def feature_expectation(self, policy: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "K"]:
        """mu(pi) = sum_t gamma^t sum_{s,a} d_t(s) pi_t(a | s) phi(s, a)."""
        visits = discounted_visits(self.dynamics, self.initial, self._actions_first(policy), self.discount)
        return visits.reshape(-1) @ self.feature_rows

    def sample(self, policy: Shaped[np.ndarray, "..."], n: int, rng: np.random.Generator) -> StatesAndActions:
        """`n` trajectories of T decisions."""
        table = self.checked_policy(policy)
        states = np.empty((n, self.horizon + 1), dtype=np.intp)
        actions = np.empty((n, self.horizon), dtype=np.intp)
        states[:, 0] = np.searchsorted(np.cumsum(self.initial), rng.random(n) * self.initial.sum(), side="right")
        for t in range(self.horizon):
            actions[:, t] = _drawn(table[t, states[:, t]], rng)
            states[:, t + 1] = self.dynamics.drawn(states[:, t], actions[:, t], rng)
        return StatesAndActions(states, actions)

    def checked_policy(self, policy: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "T S A"]:
        """`policy` for each time step. Raises `InputError` where it is no table of probabilities of this MDP."""
        states, actions, _ = self.features.shape
        stationary = np.ndim(policy) == 2
        table = finite_array("policy", policy, (states, actions) if stationary else (self.horizon, states, actions))
        _check_distributions(table, "policy", ("state",) if stationary else ("time step", "state"))
        return np.broadcast_to(table, (self.horizon, states, actions))

    def _actions_first(self, policy: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "T A S"]:
        return self.checked_policy(policy).transpose(0, 2, 1)


def _check_distributions(table: Float[np.ndarray, "*rows N"], name: str, axes: tuple[str, ...]) -> None:
    sums = table.sum(axis=-1)
    for wrong, what in (
        ((table < 0).any(axis=-1), "has a negative probability"),
        (np.abs(sums - 1.0) > SUM_TOLERANCE, "does not sum to 1"),
    ):
        if wrong.any():
            place = np.argwhere(wrong)[0] if wrong.ndim else ()
            where = " of " + ", ".join(f"{axis} {i}" for axis, i in zip(axes, place, strict=True)) if len(place) else ""
            raise InputError(f"{name}{where} {what}: {table[tuple(place)]}")


def _drawn(probabilities: Float[np.ndarray, "n N"], rng: np.random.Generator) -> Int[np.ndarray, "n"]:
    """An index for each row, by inversion; one of probability 0 is never drawn."""
    cumulated = np.cumsum(probabilities, axis=1)
    target = rng.random(len(cumulated)) * cumulated[:, -1]
    return (cumulated <= target[:, None]).sum(axis=1)
