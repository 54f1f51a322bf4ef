"""Corrections on the real arm: a scripted person, robosuite, MCAP, the reward, by the commands."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfd.about import about
from lfd.bench.corrections import PUSH_N, CorrectionsBench, Poke, _noticing, plot, sections_of
from lfd.cli import main
from lfd.core.artifact import check_output
from lfd.core.errors import InputError, LfdError, RecipeError, UnknownName
from lfd.experts.device import DeviceState, pushed
from lfd.experts.keys import WAITING, Word
from lfd.loops.correcting import (
    CorrectionRecipe,
    correct,
    learned_reward,
    learner_of,
    make_correction_world,
    report_of,
    set_up,
    start_reward,
    weights_by_push,
)
from lfd.loops.correction_results import Watching, recorded_person
from lfd.loops.correction_tasks import FEATURES, TASKS
from lfd.planning.kinematics import GRIPPER, forward
from lfd.record.episode_file import read_episode
from lfd.reward_learning.weight_belief import undone
from lfd.rewards.reward_artifact import load_reward
from tests.conftest import call_json

SEED = 2


@pytest.fixture(scope="module")
def world():
    return make_correction_world(CorrectionRecipe(task="laptop"))


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """One correction by the command, with what it printed."""
    out = tmp_path_factory.mktemp("correct") / "out"
    arguments = ["laptop", "--seed", SEED, "--runs", 1, "--out", out, "--save", out.parent / "x.rrd"]
    return out, call_json(["correct", *map(str, arguments)])


def test_a_push_teaches_the_one_feature_that_it_was_about(corrected) -> None:
    out, report = corrected
    assert report["regret"][-1] < 0.1 * report["regret"][0]
    assert report["cosine"][-1] > 0.95
    assert report["reached_goal"] == 1
    assert report["clipped_steps"] == report["stopped"] == 0
    reward = load_reward(out / "reward")
    assert reward.features == FEATURES
    np.testing.assert_allclose(reward.weights, list(report["weights"][-1].values()), atol=1e-12)
    assert (out.parent / "x.rrd").stat().st_size > 10_000
    assert (out / "reward" / "weights.png").stat().st_size > 5_000


def test_corrections_say_what_they_are_and_may_be_replaced(corrected) -> None:
    facts = about(corrected[0])
    assert (facts["kind"], facts["recordings"], facts["recipe"]["correct"]["task"]) == ("corrections", 1, "laptop")
    check_output(corrected[0], overwrite=True)


def test_the_reward_can_be_undone_to_what_was_believed_before(corrected) -> None:
    reward = load_reward(corrected[0] / "reward")
    for _ in reward.history[1:]:
        reward = undone(reward)
    np.testing.assert_allclose(reward.weights, TASKS["laptop"].start_weights, atol=1e-12)


def test_the_recording_holds_push_estimate_plans_and_weights(corrected) -> None:
    episode = read_episode(corrected[0] / "recordings" / "episode_000000.mcap")
    push, estimate = episode.signals["push"], episode.signals["external_torque"]
    assert len(push.times) == len(estimate.times) == len(episode)
    pushed = np.linalg.norm(push.values, axis=1) > 0
    assert 0.05 < pushed.mean() < 0.9
    late = pushed & np.roll(pushed, 10)  # for a tenth of a second already
    assert np.abs(estimate.values[late]).max(axis=1).mean() > 1.5
    quiet = ~pushed & ~np.any([np.roll(pushed, n) for n in range(20)], axis=0)
    quiet[:20] = False
    assert np.abs(estimate.values[quiet]).max(axis=1).mean() < 0.75
    weights = episode.signals["weights"]
    assert weights.names == FEATURES
    assert (weights.values[0] != weights.values[-1]).any()
    new = episode.signals["new_path"]
    assert len(new.times) >= 1
    goal = set_up(CorrectionRecipe(task="laptop", seed=SEED)).planner.scene.places.goal
    np.testing.assert_allclose(new.values[-1].reshape(-1, 3)[-1], goal, atol=2e-3)
    assert {"planned_path", "deformed_path"} <= set(episode.signals)


def test_recorded_pushes_push_again(corrected, world, tmp_path) -> None:
    recipe = CorrectionRecipe(task="laptop", seed=SEED, runs=1)
    person = recorded_person(corrected[0] / "recordings" / "episode_000000.mcap")
    setup, reward = set_up(recipe), start_reward(recipe)
    runs = correct(recipe, setup, learner_of(reward, recipe), person, world)
    weights = weights_by_push(runs, reward.weights)
    first = corrected[1]
    assert runs[0].effort == pytest.approx(first["effort_n_s"])
    np.testing.assert_allclose(weights[1], list(first["weights"][1].values()), atol=0.1)  # the arm's noise is another


def test_the_arm_yields_to_a_push_and_forgets_it_without_learning(world) -> None:
    recipe = CorrectionRecipe(task="table", seed=SEED, runs=1, response="impedance")
    setup, reward = set_up(recipe), start_reward(recipe)
    learner = learner_of(reward, recipe)
    poke = Poke(3.0, np.array([0.0, 0.0, 2 * PUSH_N]))
    run = correct(recipe, setup, learner, poke, world)[0]
    assert run.success
    assert len(run.noticed_s) == 1
    assert 3.0 < run.noticed_s[0] < 3.06
    assert not run.updates
    np.testing.assert_array_equal(learner.weights, reward.weights)


def test_the_arm_stands_until_its_person_says_start(world) -> None:
    class Hesitant:
        name = "hesitant"

        def __init__(self, last: Word):
            self.words = [Word.GRIPPER, Word.GRIPPER, last]

        def read(self) -> DeviceState:
            return pushed([("z", -1.0)], [self.words.pop(0)])

    told: list[tuple[str, str]] = []
    Watching(None, lambda *said: told.append(said), Hesitant(Word.START)).begin(world, {})
    assert told == 3 * [("waiting", WAITING)]
    with pytest.raises(LfdError, match="you quit before the arm went"):
        Watching(None, lambda *_: None, Hesitant(Word.QUIT)).begin(world, {})


def test_a_force_beyond_the_limit_is_clipped_and_said(world) -> None:
    recipe = CorrectionRecipe(task="table", seed=SEED, runs=1, response="impedance")
    setup, reward = set_up(recipe), start_reward(recipe)
    run = correct(recipe, setup, learner_of(reward, recipe), Poke(3.0, np.array([0.0, 400.0, 0.0])), world)[0]
    assert run.clipped == 50
    assert run.effort == pytest.approx(0.5 * 40.0)
    report = report_of(recipe, setup, [run], [reward.weights], judged=False)
    assert report["clipped_steps"] == 50
    assert "regret" not in report


def test_where_no_way_is_found_the_arm_stops(world) -> None:
    """Pressed into the table with all that is allowed, the arm cannot plan from there."""
    recipe = CorrectionRecipe(task="table", seed=SEED, runs=1)
    setup, reward = set_up(recipe), start_reward(recipe)
    poke = Poke(3.0, np.array([0.0, 0.0, -40.0]), 3.0)
    run = correct(recipe, setup, learner_of(reward, recipe), poke, world)[0]
    assert all(np.isfinite(update.planning_s) for update in run.updates)
    assert run.pushed_s == pytest.approx(3.0, abs=0.02)
    assert run.updates


@pytest.mark.parametrize("task", TASKS)
def test_scenes_hold_what_the_task_is_about(task) -> None:
    recipe = CorrectionRecipe(task=task, seed=3)
    setup = set_up(recipe)
    straight = setup.planner.features(setup.planner.straight()[None])[0]
    known = dict(zip(FEATURES, straight, strict=True))
    assert (known["laptop_closeness"] > 0) == (task == "laptop")
    assert (known["person_closeness"] > 0) == (task == "person")
    assert set_up(recipe).placement == setup.placement
    assert np.flatnonzero(setup.weights).tolist() == [TASKS[task].index]
    ends = forward(setup.planner.arm, setup.planner.straight()[[0, -1]]).points[:, GRIPPER]
    np.testing.assert_allclose(ends, [setup.placement.cup_start_m, setup.placement.cup_goal_m], atol=2e-3)


def test_what_no_correction_can_be_is_refused(lfd_fails, tmp_path, corrected) -> None:
    for recipe, sentence in (
        (CorrectionRecipe(task="cup", rule="most"), "rule in here"),
        (CorrectionRecipe(task="cup", response="fly"), "response in here"),
        (CorrectionRecipe(task="soup"), "task of corrections"),
    ):
        with pytest.raises(UnknownName, match=sentence):
            recipe.check("here")
    with pytest.raises(RecipeError, match="step = 0"):
        CorrectionRecipe(task="cup", step=0.0).check("here")
    reward = start_reward(CorrectionRecipe(task="cup"))
    other = replace(reward, features=("joint_speed", *FEATURES[1:]))
    with pytest.raises(InputError, match="the reward has features"):
        learner_of(other, CorrectionRecipe(task="cup"))
    with pytest.raises(InputError, match="duration_s = 10"):
        learner_of(reward, CorrectionRecipe(task="cup", duration_s=12.0))
    assert "known: " in lfd_fails("correct", "cup", "--robot", "robocop", "--out", tmp_path / "a")
    assert "name its folder with --dataset" in lfd_fails(
        "correct", "cup", "--demonstrations", "2", "--out", tmp_path / "b"
    )
    assert "exists already" in lfd_fails("correct", "laptop", "--out", corrected[0])
    assert "no recording" in lfd_fails("correct", "cup", "--person", tmp_path / "gone.mcap", "--out", tmp_path / "c")
    assert not any((tmp_path / name).exists() for name in "abc")


def test_pushes_are_learned_once_each() -> None:
    recipe = CorrectionRecipe(task="cup")
    reward = start_reward(recipe)
    learner = learner_of(reward, recipe)
    assert learned_reward(reward, learner) is reward


def test_a_belief_moves_as_the_weights_did_whatever_the_step_was() -> None:
    recipe = CorrectionRecipe(task="cup")
    reward = start_reward(recipe)
    learner = learner_of(reward, replace(recipe, step=1.0))  # another step than the belief began with
    way = np.zeros((4, 7))
    for size in (0.4, -0.1):
        learner.learn(
            way, way + size, np.ones(7), lambda ways: ways.sum(axis=(1, 2))[:, None] * np.array([-0.3, 0, 0, 0])
        )
    learned = learned_reward(reward, learner)
    assert len(learned.history) == 3
    np.testing.assert_allclose(learned.weights, learner.weights, atol=1e-9)


@pytest.mark.slow
def test_a_dataset_of_what_was_learned(corrected, tmp_path) -> None:
    found = call_json([
        "correct", "laptop", "--seed", str(SEED), "--runs", "1", "--reward", str(corrected[0] / "reward"),
        "--out", str(tmp_path / "more"), "--dataset", str(tmp_path / "dataset"), "--demonstrations", "2",
    ])  # fmt: skip
    assert found["dataset"]["episodes"] == 2
    reward = load_reward(tmp_path / "more" / "reward")
    assert reward.history[: len(load_reward(corrected[0] / "reward").history)]
    manifest = json.loads((tmp_path / "more" / "reward" / "manifest.json").read_text())
    assert str(corrected[0] / "reward") in manifest["parents"]
    assert main(["train", "policies/bc_mlp.toml", "--dataset", str(tmp_path / "dataset"), "--set", "train.steps=5",
                 "--out", str(tmp_path / "policy")]) == 0  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["jaco", "iiwa"])
def test_other_arms_notice_pushes_and_nothing_else(robot) -> None:
    alarms, delay = _noticing(None, (robot, 1000))
    assert alarms == 0
    assert delay is not None
    assert delay <= 0.06


def test_the_page_and_the_picture_of_the_bench(tmp_path) -> None:
    def row(response: str, effort: float) -> dict:
        return {
            "robot": "panda", "task": "cup", "seed": 0, "response": response, "effort_n_s": effort, "pushed_s": 1.0,
            "regret": [4.0, 0.2, 0.1, 0.1], "cosine": [0.0, 0.9, 1.0, 1.0], "reached_goal": 2, "runs": 2,
            "planning_ms": 20.0,
        }  # fmt: skip

    rows = [row("learn", 10.0), row("learn", 30.0), row("deform", 60.0), row("deform", 60.0)]
    rows += [row("impedance", 100.0), row("impedance", 100.0)]
    rows += [{**each, "task": task} for task in list(TASKS)[1:] for each in rows[:6]]
    measured = CorrectionsBench(
        people=2, sessions=rows, undisturbed_runs=3, false_alarms=0, delays_s=[0.02, 0.03, 0.04], unnoticed=0
    )
    sections = sections_of(measured)
    page = sections["Corrections: panda"]
    assert page["cup: regret"].endswith("after 3 pushes: 2.5% of it")
    assert "learn 20 +- 20 (0.20x); deform 60 +- 0 (0.60x); impedance 100 +- 0 (1.00x)" in page["cup: effort [N s]"]
    assert sections["Corrections: noticing a push"]["undisturbed runs of 10 s"] == "3, 0 false alarms"
    plot(measured, tmp_path / "x.png")
    assert (tmp_path / "x.png").stat().st_size > 10_000
