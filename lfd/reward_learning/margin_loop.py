"""Maximum margin planning over all policies: constraints are added as loss-augmented planning finds them violated.

The constraint of 10.6 that a given w violates most is that of

    argmax_pi  w^T mu(pi) + m(pi*, pi)

(Ratliff 2006; a cutting plane, Joachims, Finley, Yu 2009). When it is violated by no more than a tolerance, w and
v + tolerance are feasible for every policy there is, and |w|^2 + C v is at most the optimum over all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from lfd.core.errors import InputError
from lfd.planning.tabular_mdp import TabularMDP
from lfd.reward_learning.dissimilarity import expected_loss
from lfd.reward_learning.margin_planning import max_margin_planning
from lfd.rewards.checked_arrays import finite_array

LossAugmentedPlan = Callable[[Float[np.ndarray, "K"]], tuple[Shaped[np.ndarray, "..."], float]]


@dataclass(frozen=True)
class MaxMarginPlanningLoop:
    """Solution of (10.6) over all policies that the planner can find."""

    weights: Float[np.ndarray, "K"]
    """w."""
    slack: float
    """v; 0 in the hard form."""
    mus: Float[np.ndarray, "M K"]
    """mu of the policies whose constraints were used."""
    margins: Float[np.ndarray, "M"]
    """Their m(pi*, pi)."""
    violations: Float[np.ndarray, "iterations"]
    """By how much the worst policy of each iteration violated its constraint."""
    converged: bool
    """Whether the last violation is at most the tolerance."""


def max_margin_planning_loop(
    mu_expert: Shaped[np.ndarray, "..."],
    plan: LossAugmentedPlan,
    *,
    slack_weight: float | int | None,
    tolerance: float | int,
    max_iterations: int,
    nonnegative_slack: bool = True,
) -> MaxMarginPlanningLoop:
    """Alternate between 10.6 and `plan(weights)`, which returns mu (K,) and m of argmax_pi w^T mu(pi) + m(pi*, pi).

    Raises what `max_margin_planning` raises; `Infeasible` from the hard form (`slack_weight=None`) as soon as one
    policy cannot be beaten by its margin. The planner may return the expert's own policy, with m = 0.
    """
    expert = finite_array("mu_expert", mu_expert, ("K",))
    if max_iterations < 1:
        raise InputError(f"max_iterations = {max_iterations}: at least one is needed")
    mus, margins = [], []
    weights, slack, violations = np.zeros_like(expert), 0.0, []
    for _ in range(max_iterations):
        mu, margin = plan(weights)
        mu = finite_array("mu of plan(weights)", mu, expert.shape)
        violations.append(float(margin - weights @ (expert - mu) - slack) if mus else np.inf)
        if violations[-1] <= tolerance:
            break
        mus.append(mu)
        margins.append(float(margin))
        solution = max_margin_planning(
            expert,
            np.array(mus),
            margins=np.array(margins),
            slack_weight=slack_weight,
            nonnegative_slack=nonnegative_slack,
        )
        weights, slack = solution.weights, solution.slack
    return MaxMarginPlanningLoop(
        weights=weights,
        slack=slack,
        mus=np.array(mus),
        margins=np.array(margins),
        violations=np.array(violations),
        converged=violations[-1] <= tolerance,
    )


def loss_augmented_planner(mdp: TabularMDP, losses: Shaped[np.ndarray, "..."]) -> LossAugmentedPlan:
    """The exact planner for m(pi*, pi) = E_pi[sum_t l_t(s_t, a_t)] with `losses` of shape (T, S, A).

    It maximises E[sum_t gamma^t w^T phi + l_t]: the reward is discounted, the loss is not.
    """
    states, actions, _ = mdp.features.shape
    table = finite_array("losses", losses, (mdp.horizon, states, actions))
    discounts = (mdp.discount ** np.arange(mdp.horizon))[:, None, None]

    def plan(weights: Float[np.ndarray, "K"]) -> tuple[Float[np.ndarray, "K"], float]:
        policy = mdp.optimal_for(discounts * mdp.reward(weights) + table).policy
        return mdp.feature_expectation(policy), expected_loss(mdp, table, policy)

    return plan
