import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.reward_learning import (
    Infeasible,
    action_losses,
    loss_augmented_planner,
    max_margin_planning,
    max_margin_planning_loop,
    unvisited_losses,
)
from lfd.reward_learning.dissimilarity import (
    DISSIMILARITIES,
    action_difference,
    expected_loss,
    occupancy_distance,
    unit,
    unvisited_share,
)
from tests.small_mdps import deterministic_policies, probability, random_mdp, random_policy, trajectories


def test_additive_dissimilarities_are_shares_of_steps() -> None:
    mdp, rng = random_mdp(0), np.random.default_rng(0)
    expert, policy = mdp.optimal_solution(np.array([1.0, 0.5])).policy, random_policy(mdp, rng)
    expert_is_at = mdp.occupancy(expert) > 0
    differs = elsewhere = 0.0
    for tau in trajectories(mdp):
        chance = probability(tau, policy)
        for t, (x, u) in enumerate(zip(tau.states, tau.actions, strict=True)):
            differs += chance * (expert[t, x, u] == 0) / 3
            elsewhere += chance * (not expert_is_at[t, x]) / 3
    assert action_difference(mdp, expert, policy) == pytest.approx(differs)
    assert unvisited_share(mdp, expert, policy) == pytest.approx(elsewhere)


def test_occupancy_distance_by_enumeration_and_its_bounds() -> None:
    mdp, rng = random_mdp(1), np.random.default_rng(1)
    first, second = random_policy(mdp, rng), random_policy(mdp, rng)
    visits = np.zeros((2, 3, 3, 2))
    for tau in trajectories(mdp):
        for i, policy in enumerate((first, second)):
            for t, (x, u) in enumerate(zip(tau.states, tau.actions, strict=True)):
                visits[i, t, x, u] += probability(tau, policy)
    assert occupancy_distance(mdp, first, second) == pytest.approx(np.abs(visits[0] - visits[1]).sum() / 6)
    always, never = np.array([[1.0, 0.0]] * 3), np.array([[0.0, 1.0]] * 3)
    assert occupancy_distance(mdp, always, never) == pytest.approx(1)


@pytest.mark.parametrize("name", DISSIMILARITIES)
def test_a_deterministic_policy_is_not_unlike_itself(name: str) -> None:
    mdp = random_mdp(2)
    expert = mdp.optimal_solution(np.array([1.0, -1.0])).policy
    other = mdp.optimal_solution(np.array([-1.0, 1.0])).policy
    assert DISSIMILARITIES[name](mdp, expert, expert) == 0
    assert DISSIMILARITIES[name](mdp, expert, other) >= 0
    assert unit(mdp, expert, other) == 1


@pytest.mark.parametrize("losses_of", [action_losses, unvisited_losses])
@pytest.mark.parametrize("discount", [0.0, 0.7, 1.0])
def test_loss_augmented_planning_is_the_best_of_all_policies(losses_of, discount: float) -> None:
    mdp = random_mdp(3, discount=discount)
    weights = np.array([0.2, -0.1])
    losses = losses_of(mdp, mdp.optimal_solution(np.array([1.0, 0.5])).policy)
    mu, margin = loss_augmented_planner(mdp, losses)(weights)
    values = [weights @ mdp.feature_expectation(p) + expected_loss(mdp, losses, p) for p in deterministic_policies(mdp)]
    assert weights @ mu + margin == pytest.approx(max(values), abs=1e-12)


@pytest.mark.parametrize("slack_weight", [0.5, 20.0, None])
@pytest.mark.parametrize("nonnegative", [True, False])
def test_the_loop_solves_10_6_over_all_policies(slack_weight: float | None, nonnegative: bool) -> None:
    if slack_weight is None and not nonnegative:
        return
    mdp = random_mdp(4)
    expert = mdp.optimal_solution(np.array([1.0, 0.5])).policy
    losses, mu_expert = action_losses(mdp, expert), mdp.feature_expectation(expert)
    options = {"slack_weight": slack_weight, "nonnegative_slack": nonnegative}
    everything = list(deterministic_policies(mdp))
    direct = max_margin_planning(
        mu_expert,
        np.array([mdp.feature_expectation(policy) for policy in everything]),
        margins=np.array([expected_loss(mdp, losses, policy) for policy in everything]).clip(0),
        **options,
    )
    loop = max_margin_planning_loop(
        mu_expert, loss_augmented_planner(mdp, losses), tolerance=1e-10, max_iterations=100, **options
    )
    assert loop.converged
    assert loop.violations[-1] <= 1e-10
    assert len(loop.mus) == len(loop.margins) == len(loop.violations) - 1
    np.testing.assert_allclose(loop.weights, direct.weights, atol=1e-6)
    assert loop.slack == pytest.approx(direct.slack, abs=1e-6)


def test_a_suboptimal_expert_needs_slack() -> None:
    mdp = random_mdp(5)
    expert = random_policy(mdp, np.random.default_rng(5))
    plan = loss_augmented_planner(mdp, action_losses(mdp, expert))
    mu_expert = mdp.feature_expectation(expert)
    with pytest.raises(Infeasible, match="slack_weight"):
        max_margin_planning_loop(mu_expert, plan, slack_weight=None, tolerance=1e-9, max_iterations=50)
    loop = max_margin_planning_loop(mu_expert, plan, slack_weight=1.0, tolerance=1e-9, max_iterations=50)
    assert loop.converged
    assert loop.slack > 0


def test_iterations_that_run_out_are_reported() -> None:
    mdp = random_mdp(6)
    expert = mdp.optimal_solution(np.array([1.0, 0.5])).policy
    plan = loss_augmented_planner(mdp, action_losses(mdp, expert))
    loop = max_margin_planning_loop(
        mdp.feature_expectation(expert), plan, slack_weight=50.0, tolerance=1e-12, max_iterations=1
    )
    assert not loop.converged
    with pytest.raises(InputError, match=r"losses has shape \(3, 2\)"):
        loss_augmented_planner(mdp, np.zeros((3, 2)))
