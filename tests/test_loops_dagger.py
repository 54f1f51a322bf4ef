import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lfd.core.artifact import read_manifest, sha256
from lfd.core.episode import Episode
from lfd.core.errors import OutputError, RecipeError, UnknownName
from lfd.core.protocols import Observers
from lfd.core.recipe import load_toml
from lfd.data.frames import load_frames
from lfd.experts.registry import make_expert
from lfd.loops.dagger import CURVE, dagger
from lfd.loops.dagger_recipe import DATA_TABLES, LEARN_TABLES, LoopRecipes
from lfd.loops.dagger_round import PER_ROUND, STAGE, counts_of, members, round_folder, wave
from lfd.policies.acting import LearnedPolicy
from lfd.record.columns import arrays
from lfd.record.episode_file import read_episode
from lfd.record.mcap_file import read_mcap
from lfd.worlds.rollout import episode_rng
from tests.conftest import LIFT, ROOT

DAGGER_LIFT = ROOT / "policies" / "dagger_lift.toml"
SMALL = (
    "train.steps=50", "eval.episodes=2", "eval.max_seconds=2.0", "policy.hidden_sizes=[16]",
    "dagger.rounds=2", "dagger.demonstrations=2", "dagger.episodes_per_round=2",
    "dagger.beta=first",
)  # fmt: skip
SHORT = ("record.max_seconds=4.0",)


def recipes(*learn: str, data: tuple[str, ...] = SHORT) -> LoopRecipes:
    tables = load_toml(DAGGER_LIFT, LEARN_TABLES, [*SMALL, *learn])
    return LoopRecipes.of(tables, load_toml(LIFT, DATA_TABLES, list(data)))


def without_seconds(report: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in report.items() if key != "seconds"}
    if "rounds" in kept:
        kept["rounds"] = [without_seconds(row) for row in kept["rounds"]]
    return kept


def weights(policy: Path) -> bytes:
    return (policy / "model.safetensors").read_bytes()


def labels_in(episode: Episode) -> np.ndarray:
    assert episode.expert_actions is not None
    return episode.expert_actions


def files(out: Path, number: int) -> list[Path]:
    return sorted((round_folder(out, number) / "recordings").glob("*.mcap"))


@pytest.fixture(scope="module")
def looped(tmp_path_factory):
    """Two rounds of two episodes and fifty gradient steps, undisturbed; the folder and the report."""
    out = tmp_path_factory.mktemp("dagger") / "out"
    return out, dagger(recipes(), out)


# waves


@given(
    wanted=st.integers(1, 30),
    left=st.integers(1, 500),
    horizon=st.integers(1, 60),
    seed=st.integers(0, 2**32 - 1),
)
def test_waves_use_a_budget_up_to_the_last_label_and_not_beyond(wanted, left, horizon, seed) -> None:
    rng, used, run = np.random.default_rng(seed), 0, 0
    while run < wanted and used < left:
        count, most = wave(wanted - run, left - used, horizon)
        assert 1 <= count <= wanted - run
        assert 1 <= most <= horizon
        assert most == horizon or (count == 1 and most == left - used)
        used += sum(min(most, int(length)) for length in rng.integers(1, horizon + 1, count))
        run += count
    assert used <= left
    assert used == left or run == wanted


def test_without_a_budget_all_rollouts_run_side_by_side() -> None:
    assert wave(7, None, 100) == (7, 100)


# the loop


def test_the_dataset_holds_what_the_expert_said_in_the_states_that_the_learner_visited(looped, lift_world) -> None:
    out, _ = looped
    frames = load_frames(out / "dataset")
    episodes = [read_episode(file) for number in (0, 1) for file in files(out, number)]
    assert len(frames) == sum(map(len, episodes))
    labels = np.concatenate([labels_in(episode) for episode in episodes]).astype(np.float32)
    np.testing.assert_array_equal(frames.columns["action"].numpy(), labels)
    expert = make_expert(lift_world.spec, recipes().record.style)
    expert.reset(np.random.default_rng(0))
    learner = LearnedPolicy(round_folder(out, 0) / "policy", lift_world.spec)
    for file in files(out, 1):
        episode = read_episode(file)
        seen = [{name: rows[t] for name, rows in episode.observations.items()} for t in range(len(episode))]
        meant = np.array([expert.act(observation).action for observation in seen])
        np.testing.assert_allclose(labels_in(episode), meant, atol=1e-9)
        applied = np.array([decision.action for decision in learner.act_many(seen)])
        np.testing.assert_allclose(episode.actions, applied, atol=1e-5)
        names, proposed = arrays([data for _, data in read_mcap(file).messages["/policy/action"]])
        assert names == lift_world.spec.labels["action"]
        np.testing.assert_allclose(proposed, applied, atol=1e-5)
        assert not episode.interventions.any()
        assert (episode.metadata.stage, episode.metadata.policy) == ("dagger", "bc_mlp")


def test_rollouts_begin_where_their_number_says(looped, lift_world) -> None:
    out, _ = looped
    for number, file in enumerate(files(out, 1)):
        episode = read_episode(file)
        assert episode.metadata.index == PER_ROUND + number
        start = lift_world.reset(episode_rng(STAGE, episode.metadata.seed, episode.metadata.index))
        np.testing.assert_array_equal(episode.observations["cube_pos"][0], start["cube_pos"])


def test_effort_is_counted(looped) -> None:
    out, report = looped
    first, second = report["rounds"]
    lengths = [sum(len(read_episode(file)) for file in files(out, number)) for number in (0, 1)]
    assert first["labels"] == first["expert_steps"] == first["steps"] == first["labels_total"] == lengths[0]
    assert first["takeovers"] == 2  # at the start of each demonstration
    assert (second["labels"], second["takeovers"], second["expert_steps"]) == (lengths[1], 0, 0)
    assert second["labels_total"] == report["labels"] == sum(lengths)
    assert report["gradient_steps"] == 2 * 50
    assert [row["beta"] for row in report["rounds"]] == [1.0, 0.0]


def test_what_the_loop_leaves(looped) -> None:
    out, report = looped
    assert json.loads((out / "report.json").read_text()) == report
    assert (read_manifest(out) or {})["kind"] == "dagger"
    assert (out / CURVE).stat().st_size > 0
    assert report["policy_of_round"] == 1  # the last, where none is judged
    assert weights(out / "policy") == weights(round_folder(out, 1) / "policy")
    assert set(report["seconds"]) == {"rollout", "convert", "train", "eval"}
    assert not list(out.rglob("*.part"))


def test_the_policy_does_not_depend_on_the_number_of_worlds(looped, tmp_path) -> None:
    out, report = looped
    seen: list[list[int]] = []

    def watched() -> Observers:
        seen.append([])
        return lambda index: seen[-1].append(index) or ()

    rows: list[dict[str, Any]] = []
    alone = dagger(recipes(), tmp_path / "alone", most_worlds=1, watched=watched, report=rows.append)
    assert rows == alone["rounds"]
    assert [len(episodes) for episodes in seen] == [2, 2, 2, 2]  # demonstrations, evaluation, rollouts, evaluation
    assert without_seconds(alone) == without_seconds(report)
    assert weights(tmp_path / "alone" / "policy") == weights(out / "policy")


def test_a_finished_loop_goes_on_for_more_rounds_with_a_warm_start(looped, tmp_path) -> None:
    out = tmp_path / "out"
    warm = ("dagger.retrain=warm", "dagger.warm_steps=20")
    dagger(recipes(*warm), out)
    before = weights(round_folder(out, 1) / "policy")
    report = dagger(recipes(*warm, "dagger.rounds=3"), out, resume=True)
    assert [row["gradient_steps"] for row in report["rounds"]] == [50, 20, 20]
    assert weights(round_folder(out, 1) / "policy") == before
    assert weights(out / "policy") == weights(round_folder(out, 2) / "policy") != before
    assert weights(round_folder(out, 0) / "policy") == weights(round_folder(looped[0], 0) / "policy")
    first, last = (normaliser(round_folder(out, number) / "policy") for number in (0, 2))
    assert first == last  # warm weights belong to the numbers that they were trained on


def normaliser(policy: Path) -> dict[str, list[float]]:
    from safetensors.torch import load_file

    (file,) = policy.glob("policy_preprocessor*normalizer*.safetensors")
    return {key: torch.flatten(value).tolist() for key, value in load_file(file).items()}


def test_the_last_round_may_train_longer_from_new_weights(tmp_path) -> None:
    warm = ("dagger.retrain=warm", "dagger.warm_steps=10", "dagger.rounds=3", "dagger.last_steps=70")
    report = dagger(recipes(*warm), tmp_path / "out")
    assert [row["gradient_steps"] for row in report["rounds"]] == [50, 10, 70]
    with pytest.raises(OutputError, match=r"dagger\.rounds = 3, the recipe says 4"):
        dagger(recipes(*warm, "dagger.rounds=4"), tmp_path / "out", resume=True)


def test_labels_end_where_the_budgets_say(tmp_path) -> None:
    budgets = ("dagger.rounds=4", "dagger.labels_per_round=30", "dagger.episodes_per_round=100")
    demonstrated = dagger(recipes("dagger.rounds=1"), tmp_path / "first")["labels"]
    report = dagger(recipes(*budgets, f"dagger.max_labels={demonstrated + 50}"), tmp_path / "out")
    assert [row["labels"] for row in report["rounds"]] == [demonstrated, 30, 20]
    assert report["labels"] == demonstrated + 50


def test_a_mixture_is_marked_step_by_step(tmp_path) -> None:
    report = dagger(recipes("dagger.beta=exponential", "dagger.beta_rate=0.5", "eval.episodes=1"), tmp_path / "out")
    row = report["rounds"][1]
    assert row["beta"] == 0.5
    spread = 4 * np.sqrt(row["steps"] * 0.25)  # of a coin in every step
    assert abs(row["expert_steps"] - row["steps"] / 2) < spread
    assert 0 < row["takeovers"] <= row["expert_steps"]
    rows = pq.read_table(tmp_path / "out" / "dataset" / "data", columns=["intervention", "episode_index"])
    marked = np.array(rows["intervention"])[np.array(rows["episode_index"]) >= 2]
    assert marked.sum() == row["expert_steps"]
    for file in files(tmp_path / "out", 1):
        episode = read_episode(file)
        acted = (episode.actions == episode.expert_actions).all(axis=1)
        np.testing.assert_array_equal(acted, episode.interventions)


def test_an_ensemble_calls_the_expert(tmp_path) -> None:
    gate = ("dagger.gate=ensemble", "dagger.members=2", "dagger.gate_share=0.3", "dagger.gate_distance=0.8")
    made = recipes(*gate, "eval.episodes=1", "train.intervention_weight=3")
    report = dagger(made, tmp_path / "out")
    row = report["rounds"][1]
    assert row["labels"] == row["steps"]
    assert 0 < row["expert_steps"] <= row["steps"]
    assert row["gradient_steps"] == 2 * 50
    first, second = members(round_folder(tmp_path / "out", 1), made)
    assert weights(first) != weights(second)
    assert counts_of(files(tmp_path / "out", 1)[0]).labels == len(read_episode(files(tmp_path / "out", 1)[0]))


def test_the_best_judged_round_is_handed_over(looped, tmp_path) -> None:
    report = dagger(recipes("dagger.judge_episodes=2", "dagger.evaluate=last"), tmp_path / "out")
    scores = [row["judged"] for row in report["rounds"]]
    best = max(range(2), key=lambda number: (scores[number], number))
    assert report["policy_of_round"] == best
    assert weights(tmp_path / "out" / "policy") == weights(round_folder(looped[0], best) / "policy")
    assert all("success_rate" not in row for row in report["rounds"])
    assert 0.0 <= report["success_rate"] <= 1.0


# interruptions

PROGRAM = """
import sys
from pathlib import Path
from tests.test_loops_dagger import killed_recipes
from lfd.loops.dagger import dagger
dagger(killed_recipes(), Path(sys.argv[1]), resume=len(sys.argv) > 2)
"""
MOMENTS = (
    "round_000/recordings/*.mcap",
    "round_000/policy.training/checkpoint",
    "round_001/recordings/*.mcap",
    "round_001/seconds.json",
    "round_001/policy.training/checkpoint",
)
"""What appears before the loop is killed, one process after the other."""


def killed_recipes() -> LoopRecipes:
    return recipes("train.steps=300", "train.checkpoint_every=50")


@pytest.mark.slow
def test_a_loop_that_is_killed_again_and_again_ends_with_the_same_policy(tmp_path) -> None:
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    report = dagger(killed_recipes(), calm)
    ended = 0
    for number, moment in enumerate(MOMENTS):
        arguments = [str(killed), *(["resume"] if number else [])]
        run = subprocess.Popen([sys.executable, "-c", PROGRAM, *arguments], cwd=ROOT, start_new_session=True)
        while run.poll() is None and not list(killed.glob(moment)):
            time.sleep(0.001)
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
            ended += run.wait() == -signal.SIGKILL
    assert ended >= len(MOMENTS) - 1
    again = dagger(killed_recipes(), killed, resume=True)
    assert without_seconds(again) == without_seconds(report)
    assert weights(killed / "policy") == weights(calm / "policy")
    for number in (0, 1):
        assert weights(round_folder(killed, number) / "policy") == weights(round_folder(calm, number) / "policy")
        assert [f.name for f in files(killed, number)] == [f.name for f in files(calm, number)]
    assert sha256(killed / "dataset" / "data") == sha256(calm / "dataset" / "data")


# mistakes


def test_a_loop_goes_on_with_its_own_recipe_only(looped, tmp_path) -> None:
    out, _ = looped
    with pytest.raises(OutputError, match=r"made with train\.steps = 50, the recipe says 60; go on with the same"):
        dagger(recipes("train.steps=60"), out, resume=True)
    with pytest.raises(OutputError, match="exists already"):
        dagger(recipes(), out)
    with pytest.raises(OutputError, match="holds no loop to go on with; leave --resume out"):
        dagger(recipes(), tmp_path / "nothing", resume=True)


def test_the_betas_of_a_linear_schedule_belong_to_the_number_of_rounds(tmp_path) -> None:
    linear = "dagger.beta=linear"
    dagger(recipes(linear, "dagger.rounds=1", "dagger.evaluate=last", "eval.episodes=1"), tmp_path / "out")
    longer = recipes(linear, "dagger.rounds=3", "dagger.evaluate=last", "eval.episodes=1")
    with pytest.raises(OutputError, match=r"dagger\.rounds = 1, the recipe says 3"):
        dagger(longer, tmp_path / "out", resume=True)


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ("dagger.rounds=0", RecipeError, "rounds = 0: must be greater than 0"),
        ("dagger.beta=constant", UnknownName, "beta in .* 'constant'; known: exponential, first, linear"),
        ("dagger.retrain=never", UnknownName, "'never'; known: scratch, warm"),
        ("dagger.gate=ensemble", RecipeError, "compares members: set members = 3"),
        ("dagger.beta_rate=2.0", RecipeError, "must lie within 0 and 1"),
    ],
)
def test_recipes_that_cannot_be_used(given, error, says) -> None:
    with pytest.raises(error, match=says):
        recipes(given)


def test_keys_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(RecipeError, match="before the last round, which last_steps is for: leave out one"):
        recipes("dagger.last_steps=10", "dagger.max_labels=100")


def test_a_gate_takes_the_coins_place_whatever_beta_says() -> None:
    assert recipes("dagger.gate=human", "dagger.beta=linear", "dagger.rounds=3").dagger.betas == (1.0, 0.0, 0.0)
    assert recipes("dagger.beta=linear", "dagger.rounds=3").dagger.betas == (1.0, 0.5, 0.0)


def test_labels_are_what_is_learned_from() -> None:
    with pytest.raises(RecipeError, match="learns from the expert's labels.*set convert.action=expert_action"):
        recipes(data=("convert.action=action",))
    assert recipes().source.convert().failures  # rollouts that failed carry labels
