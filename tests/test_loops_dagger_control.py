"""Gates in the loop: what the expert is asked, marked and counted, and what the dataset takes of it."""

import numpy as np
import pytest

from lfd.data.frames import load_frames
from lfd.loops.dagger import dagger
from lfd.loops.dagger_control import GATE_MAKERS, learner_of, visit
from lfd.loops.dagger_recipe import GATES, HUMAN
from lfd.loops.dagger_round import counts_of, members, round_folder
from lfd.record.episode_file import read_episode
from lfd.run.gates import Ensemble, disagreement
from tests.test_loops_dagger import files, recipes


def test_every_gate_of_a_recipe_can_be_made() -> None:
    assert set(GATE_MAKERS) | {"none", HUMAN} == set(GATES)


@pytest.mark.slow
@pytest.mark.parametrize("gate", ["ensemble", "safe", "thrifty"])
def test_only_what_the_expert_was_asked_is_counted_and_learned_from(gate, tmp_path) -> None:
    options = (f"dagger.gate={gate}", "dagger.members=2", "dagger.gate_share=0.03", "dagger.gate_distance=0.0")
    options += ("dagger.demonstrations=6", "dagger.episodes_per_round=4", "eval.episodes=1", "train.steps=400")
    made = recipes(*options)
    report = dagger(made, tmp_path / "out")
    row = report["rounds"][1]
    episodes = [read_episode(file) for file in files(tmp_path / "out", 1)]
    asked = [~np.isnan(labels).all(axis=1) for e in episodes if (labels := e.expert_actions) is not None]
    assert 0 < row["labels"] == sum(each.sum() for each in asked) < row["steps"]
    for episode in episodes:
        if episode.expert_actions is None:
            assert not episode.interventions.any()
            continue
        acted = episode.interventions
        np.testing.assert_array_equal(episode.actions[acted], episode.expert_actions[acted])
        if gate != "thrifty":  # it also asks whether to hand back, and then the expert still acts
            np.testing.assert_array_equal(acted, episode.labelled)
    frames = load_frames(tmp_path / "out" / "dataset")
    assert len(frames) == report["labels"] == report["rounds"][0]["labels"] + row["labels"]
    assert frames.intervention is not None
    assert int(frames.intervention.sum()) == row["expert_steps"]
    labels = np.concatenate([e.expert_actions[e.labelled] for e in episodes if e.expert_actions is not None])
    np.testing.assert_array_equal(frames.columns["action"][-len(labels) :].numpy(), labels.astype(np.float32))
    begins, _ = frames.episodes
    assert len(begins) == 6 + sum(int((np.diff(each.astype(int), prepend=0) == 1).sum()) for each in asked)


def test_a_visit_asks_the_members_in_every_state(tmp_path, lift_world) -> None:
    made = recipes("dagger.rounds=1", "dagger.members=2", "dagger.evaluate=last", "eval.episodes=1")
    dagger(made, tmp_path / "out")
    (file, _), first = files(tmp_path / "out", 0), round_folder(tmp_path / "out", 0)
    policies = [learner_of(folder, made.tried, [lift_world]) for folder in members(first, made)]
    seen = visit(Ensemble(policies), file, ("ee_pos", "cube_pos"))
    episode = read_episode(file)
    assert counts_of(file).labels == len(episode)
    wanted = np.hstack([episode.observations["ee_pos"], episode.observations["cube_pos"]])
    np.testing.assert_array_equal(seen.states, wanted)
    assert seen.proposals.shape == (len(episode) + 1, 2, 7)
    at = 5
    observation = {name: rows[at] for name, rows in episode.observations.items()}
    for policy in policies:
        policy.reset(0, np.random.default_rng(0))
    proposals = np.array([policy.act([0], [observation])[0].action for policy in policies])
    np.testing.assert_allclose(seen.proposals[at], proposals, atol=1e-6)
    assert seen.doubts[at] == pytest.approx(disagreement(proposals), abs=1e-6)
