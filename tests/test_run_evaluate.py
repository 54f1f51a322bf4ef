import json

import numpy as np

from lfd.core.protocols import Decision
from lfd.record.episode_file import read_episode, recordings_in
from lfd.run.wilson import wilson_interval
from lfd.worlds.rollout import episode_rng


def test_the_report_says_what_the_recordings_show(thread) -> None:
    report = json.loads((thread.run / "report.json").read_text())
    episodes = [read_episode(path) for path in recordings_in([thread.run])]
    assert report["episodes"] == len(episodes) == len(report["per_episode"]) == 2
    assert report["successes"] == sum(episode.success for episode in episodes)
    assert report["mean_steps"] == np.mean([len(episode) for episode in episodes])
    assert tuple(report["interval"]) == wilson_interval(report["successes"], 2)
    printed = thread.printed["eval"]
    assert {key: report[key] for key in ("success_rate", "interval", "episodes", "seed")} == {
        key: printed[key] for key in ("success_rate", "interval", "episodes", "seed")
    }


def test_episodes_start_where_their_seed_says(thread, lift_world) -> None:
    for index, path in enumerate(recordings_in([thread.run])):
        episode = read_episode(path)
        lift_world.reset(episode_rng("eval", 0, index))
        assert episode.sim_states is not None
        np.testing.assert_array_equal(episode.sim_states[0], lift_world.sim_state())


def test_decisions_of_a_policy_are_recorded_as_its_actions(thread, lift_world) -> None:
    from lfd.policies.acting import LearnedPolicy

    episode = read_episode(recordings_in([thread.run])[0])
    policy = LearnedPolicy(thread.policy, lift_world.spec)
    policy.reset(np.random.default_rng(0))
    decision = policy.act({name: values[4] for name, values in episode.observations.items()})
    assert isinstance(decision, Decision)
    np.testing.assert_allclose(decision.action, episode.actions[4], atol=1e-6)


def test_the_result_does_not_depend_on_the_number_of_worlds(thread, tmp_path, monkeypatch) -> None:
    from lfd import evaluate
    from lfd.run.trial import EvalRecipe
    from lfd.worlds import robosuite_world

    monkeypatch.setattr(robosuite_world, "cores", lambda: 3)
    recipe = EvalRecipe(episodes=4, seed=1, max_seconds=1.0, hold_seconds=0.5)
    reports, states = [], []
    for most in (1, 3):
        out = tmp_path / str(most)
        reports.append(evaluate(thread.policy, recipe, out, most_worlds=most))
        states.append([read_episode(path).sim_states for path in recordings_in([out])])
    assert reports[0].per_episode == reports[1].per_episode
    for alone, together in zip(*states, strict=True):
        np.testing.assert_array_equal(alone, together)


def test_a_policy_decides_the_same_alone_and_among_others(thread, lift_world, rng) -> None:
    from lfd.policies.acting import LearnedPolicy

    policy = LearnedPolicy(thread.policy, lift_world.spec)
    seen = []
    for _ in range(11):
        lift_world.reset(rng)
        seen.append(lift_world.step(rng.uniform(-1, 1, 7)).observation)
    together = policy.act_many(seen)
    for observation, decision in zip(seen, together, strict=True):
        np.testing.assert_array_equal(policy.act(observation).action, decision.action)


def test_a_policy_is_run_on_another_robot_only_by_force(thread, tmp_path, lfd_fails) -> None:
    said = lfd_fails("eval", thread.policy, "--robot", "ur5e", "--episodes", "1", "--out", tmp_path / "run")
    assert "was trained for robot panda, not ur5e; add --force to run it all the same" in said
    forced = lfd_fails(
        "eval", thread.policy, "--robot", "ur5e", "--force", "--episodes", "1", "--out", tmp_path / "run"
    )
    assert "needs the observation 'joint_pos.robot0_joint1', which Lift with ur5e lacks" in forced
    assert not (tmp_path / "run").exists()
