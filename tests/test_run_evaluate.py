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
