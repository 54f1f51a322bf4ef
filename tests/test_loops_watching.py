import numpy as np
import pytest

from lfd.core.errors import OutputError, PolicyError
from lfd.experts.keys import Word
from lfd.loops.watching import trial_of, watch
from lfd.record.episode_file import read_episode
from tests.test_loops_dagger_person import person


def test_a_policy_is_watched_taken_over_and_given_back(thread, tmp_path) -> None:
    out = tmp_path / "looked_after"
    trial = trial_of(thread.policy, None, longest_s=5.0)
    done = watch(trial, out, person(Word.START, None, 1.0, 1.0, Word.HAND_BACK, None, Word.FAILURE), rollouts=1)
    assert (done.successes, done.failures) == (0, 1)
    episode = read_episode(out / "episode_000000.mcap")
    np.testing.assert_array_equal(episode.interventions, [0, 1, 1, 0, 0, 0])
    assert episode.expert_actions is not None
    np.testing.assert_array_equal(np.isfinite(episode.expert_actions[:, 0]), episode.interventions)
    watch(trial, out, person(Word.START, None, Word.FAILURE), rollouts=1)
    again = read_episode(out / "episode_000001.mcap")
    assert not np.array_equal(again.observations["cube_pos"][0], episode.observations["cube_pos"][0])


def test_what_does_not_fit_is_told_and_nothing_is_lost(thread, tmp_path) -> None:
    with pytest.raises(PolicyError, match="was trained for robot panda, not ur5e"):
        trial_of(thread.policy, "ur5e", longest_s=5.0)
    with pytest.raises(PolicyError, match=str(tmp_path)):
        trial_of(tmp_path, None, longest_s=5.0)
    trial = trial_of(thread.policy, None, longest_s=5.0)
    with pytest.raises(OutputError, match="holds a policy"):
        watch(trial, thread.policy, person(Word.START), rollouts=1)
    done = watch(trial, tmp_path / "out", person(Word.START, None, Word.FAILURE, Word.QUIT), rollouts=2)
    assert done.failures == 1  # they quit
    assert len(list((tmp_path / "out").glob("*.mcap"))) == 1
