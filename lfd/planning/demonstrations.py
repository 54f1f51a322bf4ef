"""Demonstrations in a finite MDP: the features they show, after a check that each transition can happen."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError
from lfd.planning.tabular_mdp import TabularMDP
from lfd.rewards.feature_counts import FeatureExpectations, feature_expectations

Demonstration = tuple[Shaped[np.ndarray, "..."], Shaped[np.ndarray, "..."]]
"""States and actions."""


def demonstrated_features(
    mdp: TabularMDP, states: Shaped[np.ndarray, "..."], actions: Shaped[np.ndarray, "..."]
) -> Float[np.ndarray, "T K"]:
    """phi(s_t, a_t) of one demonstration of T actions, between T + 1 states, or T if the last one was not seen.

    T may differ from the horizon. Raises `InputError` naming the step where a state or action does not exist, where a
    transition has probability 0, and where the first state does.
    """
    visited, taken = (
        _numbers(states, mdp.features.shape[0], "state"),
        _numbers(actions, mdp.features.shape[1], "action"),
    )
    if len(visited) not in (len(taken), len(taken) + 1):
        raise InputError(
            f"{len(visited)} states and {len(taken)} actions: T actions stand between T + 1 states, or after T"
        )
    if len(visited) and mdp.initial[visited[0]] == 0:
        raise InputError(f"step 0: the demonstration starts in state {visited[0]}, whose initial probability is 0")
    moves = len(visited) - 1
    possible = mdp.dynamics.possible(visited[:moves], taken[:moves], visited[1:])
    if not possible.all():
        t = int(np.argmin(possible))
        raise InputError(
            f"step {t}: action {taken[t]} in state {visited[t]} never leads to state {visited[t + 1]}; "
            "its transition has probability 0"
        )
    return mdp.features[visited[: len(taken)], taken]


def expectation_of_demonstrations(mdp: TabularMDP, demonstrations: Sequence[Demonstration]) -> FeatureExpectations:
    """mu_E as the mean over demonstrations `(states, actions)`, with the discount of the MDP.

    Raises `InputError` as `demonstrated_features` does, naming the demonstration, and when there is none.
    """
    phis = []
    for i, (states, actions) in enumerate(demonstrations):
        try:
            phis.append(demonstrated_features(mdp, states, actions))
        except InputError as error:
            raise InputError(f"demonstration {i}, {error}") from error
    return feature_expectations(phis, discount=mdp.discount)


def log_likelihood(
    mdp: TabularMDP, policy: Shaped[np.ndarray, "..."], demonstrations: Sequence[Demonstration]
) -> float:
    """Mean over demonstrations of sum_t log pi_t(a_t | s_t), natural logarithm; -inf for what the policy never does.

    Raises `InputError` without a demonstration and for one that is longer than the horizon.
    """
    table = mdp.checked_policy(policy)
    if len(demonstrations) == 0:
        raise InputError("no demonstration is given; a mean needs at least one")
    sums = []
    for i, (states, actions) in enumerate(demonstrations):
        visited, taken = np.asarray(states), np.asarray(actions)
        if len(taken) > mdp.horizon:
            raise InputError(f"demonstration {i} has {len(taken)} actions, the policy is made for {mdp.horizon}")
        chances = table[np.arange(len(taken)), visited[: len(taken)], taken]
        sums.append(-np.inf if (chances == 0).any() else float(np.log(chances).sum()))
    return float(np.mean(sums))


def _numbers(values: Shaped[np.ndarray, "..."], count: int, kind: str) -> Shaped[np.ndarray, "N"]:
    numbers = np.asarray(values)
    if numbers.ndim != 1 or (numbers.size and numbers.dtype.kind not in "iu"):
        raise InputError(f"{kind}s must be a row of whole numbers, not {numbers.dtype} of shape {numbers.shape}")
    numbers = numbers.astype(np.intp)
    outside = (numbers < 0) | (numbers >= count)
    if outside.any():
        t = int(np.argmax(outside))
        raise InputError(f"step {t}: {kind} {numbers[t]} does not exist; {kind}s are 0 to {count - 1}")
    return numbers
