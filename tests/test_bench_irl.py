"""That the bench of inverse RL measures what it says, on grids that are small enough to check by hand."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfd.bench.irl import Ambiguity, IrlBench, Point, ambiguity_of, interval, plot, point_of, sections_of
from lfd.bench.irl_arm import EXPERTS, ArmBench, ArmPoint, bench_arm
from lfd.bench.irl_arm import rows_of as arm_rows
from lfd.bench.irl_methods import METHODS, Learned, demonstrated_losses, evidence_of, learn, pairs
from lfd.bench.irl_peer import Beside, each_log_likelihood, rows_of, run_program, visited_states
from lfd.bench.irl_problems import (
    BEST_STEP,
    OPTIMAL,
    PROBLEMS,
    SOFT,
    macro_grid,
    make_problem,
    problem_of,
    uniform_policy,
)
from lfd.bench.peers.process import PeerError, peers_folder
from lfd.core.protocols import silent
from lfd.planning import StatesAndActions, log_likelihood
from lfd.reward_learning import maxent_tabular
from tests.conftest import call_json


def small(seed: int = 0, discount: float = 0.9):
    """Grid-world of 4 x 4 cells in 4 regions."""
    return problem_of(macro_grid(size=4, block=2, horizon=6, discount=discount, rng=np.random.default_rng(seed)))


def test_regions_are_the_features_and_the_best_one_has_the_set_reward() -> None:
    grid = macro_grid(size=6, block=2, horizon=3, discount=0.9, rng=np.random.default_rng(1))
    features = grid.mdp.features[:, 0].reshape(6, 6, 9)
    for row in range(6):
        for column in range(6):
            assert features[row, column].argmax() == 3 * (row // 2) + column // 2
            assert features[row, column].sum() == 1
    assert grid.true_reward.max() == pytest.approx(BEST_STEP)
    assert np.count_nonzero(np.unique(grid.true_reward)) >= 2


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_loss_is_0_for_the_optimal_policy_and_1_for_random_actions(name: str) -> None:
    problem = make_problem(name, size=8, rng=np.random.default_rng(3))
    values = {expert: float(problem.truth.feature_expectation(p)[0]) for expert, p in problem.experts.items()}
    assert problem.loss(values[OPTIMAL]) == pytest.approx(0.0, abs=1e-12)
    assert 0.0 < problem.loss(values[SOFT]) < 1.0
    random = float(problem.truth.feature_expectation(uniform_policy(problem.mdp))[0])
    assert problem.loss(random) == pytest.approx(1.0)


def test_losses_are_the_share_of_steps_known_to_differ_from_the_demonstrations() -> None:
    mdp = small().mdp
    shown = StatesAndActions(np.array([[0, 1, 0, 5, 5, 5, 5]]), np.array([[4, 3, 4, 0, 0, 2]]))
    losses = demonstrated_losses(mdp, shown)
    assert losses.shape == (6, 16, 5)
    np.testing.assert_allclose(losses[2, 0], [1 / 6, 1 / 6, 1 / 6, 1 / 6, 0])  # 4 both times
    np.testing.assert_allclose(losses[0, 5], [1 / 18, 1 / 6, 1 / 9, 1 / 6, 1 / 6])  # 0, 0, 2; the last state has none
    assert (losses[:, 2:5] == 0).all()  # never seen


@pytest.mark.parametrize("method", METHODS)
def test_from_many_demonstrations_every_method_does_nearly_as_well_as_the_expert(method: str) -> None:
    problem, rng = small(), np.random.default_rng(0)
    for expert, policy in problem.experts.items():
        learned = learn(method, evidence_of(problem.mdp, problem.mdp.sample(policy, 2000, rng)))
        point = point_of(problem, policy, learned)
        own = problem.loss(float(problem.truth.feature_expectation(policy)[0]))
        assert point.policy_evd < own + 0.1, expert
        assert learned.shares.sum() == pytest.approx(1.0)
        assert len(learned.policies()) == len(learned.shares)
        assert point.seconds > 0


def test_a_point_is_that_of_the_policies_handed_over_with_their_shares() -> None:
    problem = small()
    optimal, uniform = problem.experts[OPTIMAL], uniform_policy(problem.mdp)
    learned = Learned(np.zeros(4), np.array([0.25, 0.75]), lambda: [optimal, uniform], 1.5, True)
    point = point_of(problem, optimal, learned)
    assert point.policy_evd == pytest.approx(0.75)  # values mix as policies do
    assert point.gap == pytest.approx(0.75)
    stays = problem.mdp.optimal_solution(np.zeros(4)).policy
    assert point.weights_evd == pytest.approx(problem.loss(float(problem.truth.feature_expectation(stays)[0])))


def test_indicators_leave_one_direction_open_and_moving_along_it_changes_nothing() -> None:
    mdp = small().mdp
    found = ambiguity_of(mdp, np.array([0.0, 1.0, 0.0, 2.0]), demonstrations=10**9)
    assert (found.features, found.identified, found.told) == (4, 3, 3)
    assert 0 < found.unchanged < 1e-12
    assert ambiguity_of(mdp, np.zeros(4), demonstrations=0).told == 0
    everything = replace(mdp, features=mdp.features[:, :, :3])
    assert ambiguity_of(everything, np.zeros(3), demonstrations=1).unchanged == 0.0


def test_more_demonstrations_tell_more_directions() -> None:
    mdp = small().mdp
    told = [ambiguity_of(mdp, np.zeros(4), demonstrations=count).told for count in (1, 10, 10_000)]
    assert told == sorted(told)
    assert told[-1] == 3


def test_intervals_are_student_s() -> None:
    mean, low, high = interval([1.0, 2.0, 3.0])
    assert mean == 2.0
    assert high - mean == pytest.approx(mean - low)
    assert high - mean == pytest.approx(4.302653 / np.sqrt(3))  # t of 2 degrees of freedom, standard deviation 1
    assert np.isnan(interval([1.0])[1:]).all()


def test_visited_states_count_one_more_than_decisions() -> None:
    problem = small(discount=1.0)
    mdp, policy = problem.mdp, problem.experts[SOFT]
    longer = np.concatenate([policy, policy[:1]])
    expected = replace(mdp, horizon=mdp.horizon + 1).occupancy(longer).sum(axis=0)
    np.testing.assert_allclose(visited_states(problem), expected)
    assert visited_states(problem).sum() == pytest.approx(mdp.horizon + 1)


def test_likelihoods_are_those_of_single_demonstrations() -> None:
    problem = small()
    shown = problem.mdp.sample(problem.experts[SOFT], 5, np.random.default_rng(0))
    each = each_log_likelihood(problem.mdp, problem.experts[SOFT], shown)
    assert each.shape == (5,)
    assert each.mean() == pytest.approx(log_likelihood(problem.mdp, problem.experts[SOFT], pairs(shown)))


def test_a_program_that_fails_says_why(tmp_path) -> None:
    program = tmp_path / "program.py"
    program.write_text("import sys; sys.exit('no such grid')")
    with pytest.raises(PeerError, match=r"program.py ended: no such grid"):
        run_program(Path(sys.executable), program, tmp_path)


def test_the_page_says_how_much_faster_and_how_likely() -> None:
    grid = Beside(
        iterations=(30, 120), seconds=(0.2, 40.0), gradients=(0.008, 0.009), held_out=(-79.0, -80.0),
        held_out_truth=-78.5, difference=(1.0, 0.1),
    )  # fmt: skip
    rows = rows_of([grid, replace(grid, seconds=(0.2, 60.0)), grid])
    assert rows["time to the tolerance"] == "200x faster (at least 200x)"
    assert rows["time of a step"] == "50x faster"
    assert rows["lfd: to the tolerance"] == "30 steps, 0.2 s, last gradients at most 0.008"
    assert rows["lfd less imitation, each grid [nat]"] == "+1.00 +- 0.20, +1.00 +- 0.20, +1.00 +- 0.20"


def test_the_page_and_the_picture(tmp_path) -> None:
    def point(evd: float) -> Point:
        return Point(weights_evd=evd, policy_evd=evd / 2, gap=0.1, seconds=0.5, converged=evd < 0.5)

    at = [[point(0.5), point(0.7)], [point(0.1), point(0.3)]]

    def on_arm(evd: float) -> ArmPoint:
        return ArmPoint(evd=evd, gap=evd / 2, seconds=0.5)

    few = [[on_arm(137.0), on_arm(0.2), on_arm(0.4)], [on_arm(0.01), on_arm(0.03), on_arm(0.02)]]
    arm = ArmBench(
        counts=(1, 10),
        held_out=4,
        seeds=(0, 1, 2),
        points={expert: dict.fromkeys(("apprenticeship", "margin", "maxent"), few) for expert in (SOFT, OPTIMAL)},
        experts={SOFT: [0.07, 0.08, 0.06], OPTIMAL: [0.0, 0.0, 0.0]},
    )
    measured = IrlBench(
        size=8,
        counts=(4, 64),
        seeds=(0, 1),
        points={name: {expert: dict.fromkeys(METHODS, at) for expert in (SOFT, OPTIMAL)} for name in PROBLEMS},
        experts={name: {SOFT: [0.1, 0.2], OPTIMAL: [0.0, 0.0]} for name in PROBLEMS},
        ambiguity={
            name: [
                Ambiguity(features=9, identified=8, told=told, unchanged=change)
                for told, change in ((5, 1e-15), (7, 1e-14))
            ]
            for name in PROBLEMS
        },
        arm=arm,
        beside=(),
        missing="no network",
    )
    grid, objects, cup, told, beside = sections_of(measured).values()
    assert grid == objects
    low, high = 0.2 - 12.7062 * 0.1, 0.2 + 12.7062 * 0.1  # t of one degree of freedom
    said = f"0.200 [{low:.3f}, {high:.3f}]"
    assert grid["EVD of the weights, soft expert, 64 demonstrations"] == "; ".join(f"{m} {said}" for m in METHODS)
    assert grid["EVD of apprenticeship's mixture, soft expert"].startswith("0.300 [")
    assert grid["reached their tolerance, optimal expert"].startswith("apprenticeship 2 of 4; ")
    assert told["grid-world: features"] == "9"
    assert told["grid-world: told to within 1 nat by 64 demonstrations of the maximum entropy policy"] == "5 to 7"
    assert told["objectworld: largest change of an action's probability, w moved by 10 along the others"] == "1.0e-14"
    assert cup["scenes"] == "3 x 4 held out; medians over seeds, (smallest to largest)"
    assert cup["EVD of the soft expert itself"] == "0.07 (0.06 to 0.08)"
    assert cup["EVD of the weights, soft expert, 1 demonstration"].startswith("apprenticeship 0.4 (0.2 to 137); margin")
    assert cup["feature gap, optimal expert, 10 demonstrations"].endswith("; maxent 0.01 (0.005 to 0.015)")
    assert beside == {"imitation": "left out: no network"}
    plot(measured, tmp_path / "inverse_rl.png")
    assert (tmp_path / "inverse_rl.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_an_arm_s_demonstrators_pay_what_they_should_and_every_method_is_judged() -> None:
    with silent("", 1) as bar:
        found = bench_arm(counts=(1,), held_out=1, seeds=(3,), bar=bar)
    assert found.experts[OPTIMAL] == [0.0]
    assert 0.02 < found.experts[SOFT][0] < 0.2
    assert set(found.points) == set(EXPERTS) == {SOFT, OPTIMAL}
    for methods in found.points.values():
        for ((point,),) in methods.values():
            assert point.evd > -0.05  # below 0 by what plans pay for coming near to things, which is no cost here
            assert point.gap >= 0
            assert point.seconds > 0
    assert len(arm_rows(found)) == 9


@pytest.mark.slow
def test_the_command_is_quick() -> None:
    found = call_json(["bench", "irl", "--quick"])
    assert found["missing"] == "not asked for"
    assert set(found["points"]) == set(PROBLEMS)
    assert set(found["arm"]["points"]) == {SOFT, OPTIMAL}
    for world in found["ambiguity"]["grid-world"]:
        assert (world["features"], world["identified"]) == (64, 63)


@pytest.mark.slow
@pytest.mark.skipif(not (peers_folder() / "bin" / "python").is_file(), reason="imitation is not installed")
def test_imitation_finds_the_same_policy_and_needs_more_steps() -> None:
    from lfd.bench.irl_peer import ask_imitation

    problem = small(discount=1.0)
    mdp, expert = problem.mdp, problem.experts[SOFT]
    ours = maxent_tabular(mdp, mdp.feature_expectation(expert), tolerance=0.01)
    theirs = ask_imitation(peers_folder() / "bin" / "python", mdp, visits=visited_states(problem))
    np.testing.assert_allclose(ours.policy, expert, atol=0.02)
    np.testing.assert_allclose(theirs.policy, expert, atol=0.02)
    assert theirs.gradient <= 0.01
    assert theirs.iterations > ours.iterations
    shown = mdp.sample(expert, 500, np.random.default_rng(0))
    learned = ask_imitation(peers_folder() / "bin" / "python", evidence_of(mdp, shown).mdp, shown=shown)
    assert log_likelihood(mdp, learned.policy, pairs(shown)) > log_likelihood(mdp, uniform_policy(mdp), pairs(shown))
