import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

from lfd.cli import main
from lfd.core.errors import InputError, UnknownName
from lfd.loops.arm_evidence import Demonstration, Evidence
from lfd.loops.comparing import (
    Comparison,
    Question,
    Rules,
    alignment,
    alignments,
    answers_of,
    answers_table,
    ask,
    no_answers_yet,
)
from lfd.loops.comparison_folder import Folder, resumed
from lfd.loops.comparison_people import AtTerminal, FromFile, Simulated
from lfd.loops.comparison_pictures import plan_clip, posterior_picture, question_clip
from lfd.loops.comparison_pool import DEMONSTRATOR, Pool, _distinct, _of_evidence, make_pool, pool_of
from lfd.loops.comparison_result import plan_for, regret
from lfd.loops.plan_demonstrations import draw_scenes
from lfd.loops.plans_beside import shown_for
from lfd.loops.reward_judging import costs
from lfd.rewards.reward_artifact import load_reward
from tests.conftest import ROOT, call_json

CUP = ROOT / "datasets" / "cup_panda.toml"
RULES = Rules(criterion="information_gain", rationality=1.0, batch=1, seed=3)


@cache
def pool() -> Pool:
    return make_pool(CUP, features=None, size=14, seed=11)[0]


def begun(**changes: object) -> Comparison:
    return Comparison(pool(), no_answers_yet(pool()), replace(RULES, **changes))


def returns() -> np.ndarray:
    recipe = pool().recipe
    return pool().counts @ np.append(recipe.weights, recipe.smoothness)


def nothing(_: Comparison) -> None:
    """Where nothing is kept."""


def test_the_pool_is_of_plans_that_touch_nothing_counted_as_the_planner_counts() -> None:
    found = pool()
    planner = found.planner(0)
    assert found.names[0] == DEMONSTRATOR
    assert len(found.names) == 15
    assert (planner.clearance(found.trajectories) >= 0).all()
    np.testing.assert_allclose(found.counts[:, :-1], planner.features(found.trajectories))
    recipe = found.recipe
    np.testing.assert_allclose(-returns(), costs(planner, recipe.weights, recipe.smoothness, found.trajectories))
    assert returns().argmax() == 0  # the demonstrator's own plan is the best by their weights
    assert len(found.pairs) == 15 * 14 // 2
    again = pool_of(json.loads(json.dumps(found.table())), "a file")
    np.testing.assert_array_equal(again.counts, found.counts)
    assert again.recipe == found.recipe
    with pytest.raises(InputError, match="a file lacks units; compare again"):
        pool_of({k: v for k, v in found.table().items() if k != "units"}, "a file")


def test_pairs_are_of_one_scene_and_never_of_equal_trajectories() -> None:
    one = pool()
    two = replace(one, scenes=(*one.scenes, one.scenes[0]), scene_of=(np.arange(15) >= 10).astype(int))
    assert len(two.pairs) == 10 * 9 // 2 + 5 * 4 // 2
    assert (two.scene_of[two.pairs[:, 0]] == two.scene_of[two.pairs[:, 1]]).all()
    comparison = begun()
    same = Question(0, 4, 4, 1.0)
    comparison.answer(same, "a")
    with pytest.raises(InputError, match="compared with one of the same features says nothing about w"):
        comparison.belief()


def test_an_answer_counts_features_and_the_planner_s_prior() -> None:
    comparison = begun(rationality=2.0)
    comparison.answer(Question(0, 0, 5, 1.0), "a")
    factor, truth = comparison.factor(comparison.answers[0]), np.array(pool().recipe.weights)
    x = factor.rationality * (factor.difference @ truth + factor.offset)
    assert x == pytest.approx(2.0 * (returns()[0] - returns()[5]))


def test_a_simulated_person_errs_as_the_model_says() -> None:
    person = Simulated(pool(), rationality=0.02, seed=5)
    a, b = 3, 8
    said = np.mean([person(Question(n, a, b, 1.0)) == "a" for n in range(4000)])
    assert said == pytest.approx(expit(0.02 * (returns()[a] - returns()[b])), abs=0.03)


def test_the_person_s_weights_are_found_and_their_plan() -> None:
    comparison, truth = begun(), np.array(pool().recipe.weights)
    ended = ask(comparison, Simulated(pool(), rationality=1.0, seed=3), questions=20, stop_below=0.0, save=nothing)
    assert ended == "20 questions were answered"
    found = alignments(comparison, truth)
    assert len(found) == 21
    assert found[0] == 0.0
    assert found[-1] > 0.95
    reward = comparison.reward()
    np.testing.assert_allclose(reward.weights, comparison.belief().mode, rtol=1e-6)
    assert len(reward.history) == 21
    assert reward.history[1].evidence.startswith("answer 1: ")
    pairs = {frozenset((a.question.a, a.question.b)) for a in comparison.answers}
    assert len(pairs) == 20
    plan = plan_for(pool(), reward.weights, scene=0, seed=0)
    lost = regret(pool(), plan, scene=0)
    assert lost is not None
    assert lost < 0.5
    assert not plan.collides


@pytest.mark.parametrize("criterion", ["random", "volume_removal", "expected_volume"])
def test_every_criterion_asks(criterion: str) -> None:
    comparison = begun(criterion=criterion)
    ask(comparison, Simulated(pool(), rationality=1.0, seed=3), questions=4, stop_below=0.0, save=nothing)
    assert len(comparison.answers) == 4


def test_questions_depend_on_answers_and_seed_alone_also_after_undo_and_in_batches() -> None:
    for batch in (1, 3):
        straight, torn = begun(batch=batch), begun(batch=batch)
        person = Simulated(pool(), rationality=1.0, seed=3)
        ask(straight, person, questions=7, stop_below=0.0, save=nothing)
        ask(torn, person, questions=5, stop_below=0.0, save=nothing)
        for _ in range(3):
            torn.undo()
        kept = json.loads(json.dumps(answers_table(torn)))
        later = begun(batch=batch)
        later.answers.extend(answers_of(kept, pool(), "a file"))
        ask(later, person, questions=7, stop_below=0.0, save=nothing)
        assert answers_table(later) == answers_table(straight)
        np.testing.assert_array_equal(later.belief().mode, straight.belief().mode)


def test_it_stops_when_no_question_is_worth_its_cost_or_none_is_left() -> None:
    comparison = begun()
    ended = ask(comparison, lambda _: "a", questions=5, stop_below=1.1, save=nothing)
    assert ended.startswith("no question was worth its cost: the best would tell")
    assert not comparison.answers
    one = pool()
    few = replace(one, scene_of=one.scene_of[:3], names=one.names[:3], trajectories=one.trajectories[:3])
    small = Comparison(few, no_answers_yet(few), RULES)
    assert "every pair of the pool" in ask(small, lambda _: "equal", questions=9, stop_below=-1.0, save=nothing)
    assert len(small.answers) == 3


def test_a_person_at_the_terminal_is_asked_again_and_can_undo_and_stop(capfd) -> None:
    shown: list[Question] = []

    def show(question: Question) -> str:
        shown.append(question)
        return "somewhere"

    comparison, told = begun(), list[str]()
    replies = iter(["u\n", "what?\n", " A\n", "e\n", "u\n", "b\n", "q\n"])
    ended = ask(
        comparison, AtTerminal(show, replies=replies), questions=9, stop_below=0.0, save=nothing, tell=told.append
    )
    assert ended == "stopped; --resume goes on"
    assert [a.choice for a in comparison.answers] == ["a", "b"]
    assert told == ["nothing to undo: no question was answered yet"]
    assert [question.number for question in shown] == [0, 0, 1, 2, 1, 2]
    assert shown[4] == shown[2]
    assert capfd.readouterr().err.count("a or b: the one you like better") == 2


def test_answers_that_contradict_each_other_are_taken_and_said() -> None:
    steady, torn = begun(rationality=0.1), begun(rationality=0.1)
    for number in range(6):
        steady.answer(Question(number, 0, 7, 1.0), "a")
        torn.answer(Question(number, 0, 7, 1.0), "ab"[number % 2])
    assert steady.belief().consistency > 0.75
    assert torn.belief().consistency < 0.55


def test_alignment_is_a_cosine_over_ranges() -> None:
    assert alignment(np.array([1.0, 0.0]), np.array([1.0, 10.0]), np.array([1.0, 0.1])) == pytest.approx(0.5**0.5)
    assert alignment(np.zeros(2), np.ones(2), np.ones(2)) == 0.0


def test_recordings_are_compared_within_their_scenes() -> None:
    one = pool()
    scenes = draw_scenes(replace(one.recipe, scenes=2))
    shown = tuple(Demonstration(f"{n}.mcap", scenes[0], one.trajectories[n].copy()) for n in range(3))
    alone = Demonstration("alone.mcap", scenes[1], one.trajectories[3].copy())
    evidence = Evidence(recipe=one.recipe, demonstrations=(*shown, alone, shown[0]), parents={})
    found = _distinct(_of_evidence(evidence, one.features, seed=0))
    assert found.names == ("0", "1", "2", "alone")
    assert found.scene_of.tolist() == [0, 0, 0, 1]
    assert found.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert (found.units > 0).all()


def test_a_feature_that_is_the_same_for_all_is_refused() -> None:
    one = pool()
    still = replace(one, trajectories=np.repeat(one.trajectories[:1], 15, axis=0))
    with pytest.raises(InputError, match="person_closeness is the same for all of the pool: .*leave it out"):
        no_answers_yet(still)


def test_what_was_killed_goes_on_from_the_last_answer(tmp_path: Path) -> None:
    comparison = begun()
    folder = Folder(tmp_path / "out", {str(CUP): "ab12"}, comparison)
    folder.begin(overwrite=False)

    def save(_: Comparison) -> None:
        folder.replies += 1
        folder.save()

    person = Simulated(pool(), rationality=1.0, seed=3)
    ask(comparison, person, questions=3, stop_below=0.0, save=save)
    found = resumed(tmp_path / "out")
    assert answers_table(found.comparison) == answers_table(comparison)
    assert (found.replies, found.parents) == (3, {str(CUP): "ab12"})
    assert found.comparison.question() == comparison.question()
    np.testing.assert_array_equal(found.comparison.belief().mode, comparison.belief().mode)
    reward = found.end(ended="as asked", also={"report.json": b"{}"})
    np.testing.assert_array_equal(load_reward(tmp_path / "out").weights, reward.weights)
    shown = shown_for(tmp_path / "out", None)
    assert [one.placement for one in shown.demonstrations] == list(pool().scenes)
    (tmp_path / "out" / "comparing.json").write_text("{}")
    with pytest.raises(InputError, match="is no state of a comparison"):
        resumed(tmp_path / "out")


def test_a_question_shows_the_arm_as_a_and_then_as_b() -> None:
    question = Question(0, 2, 5, 1.0)
    clip, shapes = question_clip(pool(), question)
    assert clip.qpos is not None
    assert clip.model is not None
    places = [int(clip.model.joint(f"robot0_joint{k}").qposadr[0]) for k in range(1, 8)]
    rows = len(clip.times) // 2
    for first, number in ((0, 2), (rows, 5)):
        moved = clip.qpos[first : first + rows, places]
        np.testing.assert_allclose(moved[[0, -1]], pool().trajectories[number][[0, -1]])
    np.testing.assert_allclose(clip.positions["a"][rows:], np.repeat(clip.positions["a"][-1:], rows, axis=0))
    np.testing.assert_allclose(clip.positions["b"][:rows], np.repeat(clip.positions["b"][:1], rows, axis=0))
    assert (np.diff(clip.times) > 0).all()
    assert {path.removeprefix("plots/") for path in clip.curves} == set(pool().features)
    assert len(shapes) == 4


def test_the_pictures_of_the_end() -> None:
    comparison = begun()
    ask(comparison, Simulated(pool(), rationality=1.0, seed=3), questions=2, stop_below=0.0, save=nothing)
    reward, truth = comparison.reward(), np.array(pool().recipe.weights)
    for known, aligned in ((truth, alignments(comparison, truth)), (None, [])):
        picture = posterior_picture(comparison, reward, truth=known, aligned=aligned)
        assert picture.startswith(b"\x89PNG")
    plan = plan_for(pool(), truth, scene=0, seed=0)
    clip, _ = plan_clip(pool(), plan, 0)
    assert {"planned", "pool_0", "pool_11"} <= set(clip.positions)


def test_bad_rules_answers_and_replies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="unknown criterion 'guess'"):
        replace(RULES, criterion="guess")
    with pytest.raises(InputError, match="rationality = 0.0: give a positive number"):
        replace(RULES, rationality=0.0)
    with pytest.raises(InputError, match="batch = 13: give 1 to 12"):
        replace(RULES, batch=13)
    with pytest.raises(InputError, match="batch = 2 is for information_gain"):
        replace(RULES, batch=2, criterion="random")
    with pytest.raises(InputError, match="nothing to undo"):
        begun().undo()
    good = {"number": 0, "a": 1, "b": 2, "bits": 0.5, "choice": "a"}
    for change, message in (
        ({"a": 15}, "answer 0 is about .* no pair of the pool"),
        ({"number": 1}, "no pair of the pool"),
        ({"choice": "c"}, "unknown choice 'c'"),
        ({"bits": None}, "answer 0 is none"),
    ):
        with pytest.raises(InputError, match=message):
            answers_of([good | change], pool(), "a file")
    other = replace(no_answers_yet(pool()), smoothness=1.0)
    with pytest.raises(InputError, match="planned with smoothness = 400.0, the reward with 1.0"):
        Comparison(pool(), other, RULES)
    turned = replace(pool(), features=tuple(reversed(pool().features)))
    with pytest.raises(InputError, match="the pool has the features .* in the same order"):
        Comparison(turned, no_answers_yet(pool()), RULES)
    (tmp_path / "answers").write_text("a\n# a note\nperhaps\n")
    with pytest.raises(InputError, match="answers, line 3: 'perhaps' is no answer; write one of a, b, e, equal, u, q"):
        FromFile(tmp_path / "answers", taken=0)


@pytest.mark.slow
def test_a_file_answers_is_resumed_and_its_reward_is_shown_updated_and_undone(tmp_path: Path, lfd_fails) -> None:
    out, whole, answers = tmp_path / "out", tmp_path / "whole", tmp_path / "answers"
    answers.write_text("a\nb\n\nu\ne  # about the same\n")
    compare = ["compare", str(CUP), "--plans", "8", "--person", str(answers), "--questions", "4"]
    first = call_json([*compare, "--out", str(out)])
    assert (first["answers"], first["ended"]) == (2, "stopped; --resume goes on")
    answers.write_text(answers.read_text() + "b\na\n")
    wrong = lfd_fails(*compare, "--out", out, "--resume", "--rationality", "2")
    assert "--rationality 2.0: the comparison in" in wrong
    assert "was begun with 1.0; leave it out" in wrong
    assert "--features is decided when a comparison begins" in lfd_fails(
        *compare, "--out", out, "--resume", "--features", "cup_tilt"
    )
    second = call_json([*compare, "--out", str(out), "--resume"])
    assert second["answers"] == 4
    call_json([*compare, "--out", str(whole)])
    assert (out / "reward.json").read_text() == (whole / "reward.json").read_text()
    assert {p.name for p in out.iterdir()} == {
        "comparing.json", "manifest.json", "plan.rrd", "pool.json", "posterior.png", "report.json", "reward.json",
    }  # fmt: skip
    shown = call_json(["reward", "show", str(out)])
    assert shown["evidence"] == {"gaussian": 1, "choice": 4}
    assert shown["consistency"] == pytest.approx(second["consistency"])
    assert shown["weights"]["cup_tilt"]["unit"] == "1/(1 s)"
    history = call_json(["reward", "history", str(out)])["changes"]
    assert [len(change["before"]) for change in history] == [0, 5, 5, 5, 5]
    before = tmp_path / "before"
    undone = call_json(["reward", "undo", str(out), "--out", str(before)])
    assert undone["undone"] == history[-1]["evidence"]
    assert list(load_reward(before).weights) == history[-1]["before"]
    assert len(load_reward(out).history) == 5
    for _ in range(4):
        assert main(["reward", "undo", str(out)]) == 0
    assert "nothing to undo: the history has only what the reward began with" in lfd_fails("reward", "undo", out)
    assert "there is nothing to resume; leave out --resume" in lfd_fails(*compare, "--out", out, "--resume")
    more = ["compare", str(CUP), "--plans", "8", "--reward", str(before), "--person", "simulated", "--questions", "2"]
    third = call_json([*more, "--out", str(tmp_path / "more")])
    assert len(third["alignment"]) == 3
    assert len(load_reward(tmp_path / "more").history) == 6
    assert main(["trace", str(tmp_path / "more")]) == 0


def test_bad_input_of_the_command_is_a_sentence(lfd_fails, tmp_path: Path, thread) -> None:
    out = ("--out", tmp_path / "out")
    assert "no recipe" in lfd_fails("compare", tmp_path / "none.toml", *out)
    assert "keeps no scene to plan in" in lfd_fails("compare", thread.recordings, *out)
    assert "holds no reward.json" in lfd_fails("compare", CUP, "--reward", tmp_path, *out)
    assert "there is nothing to resume" in lfd_fails("compare", CUP, "--resume", *out)
    assert "rationality = -1.0: give a positive number" in lfd_fails("compare", CUP, "--rationality", "-1", *out)
    assert "unknown arm feature" in lfd_fails("compare", CUP, "--features", "cup_tlt", *out)
    assert "--person takes me, simulated, or a file" in lfd_fails("compare", CUP, "--person", "nobody", *out)
    assert not (tmp_path / "out").exists()
