from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfd.core.errors import LfdError
from lfd.core.recipe import build, load_toml
from lfd.record.demonstrations import RecordRecipe, record
from lfd.record.episode_file import read_episode, recordings_in
from lfd.worlds import robosuite_world

RECIPE = Path("datasets/lift_panda.toml")


@pytest.fixture
def short() -> RecordRecipe:
    """So little time that some attempts fail."""
    recipe = build(RecordRecipe, load_toml(RECIPE, ["record", "convert"])["record"], "recipe")
    return replace(recipe, episodes=3, max_seconds=1.9, attempts_per_episode=20)


def test_what_is_recorded_does_not_depend_on_the_number_of_worlds(short, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(robosuite_world, "_cores", lambda: 3)
    recorded = []
    for most in (1, 3):
        out = tmp_path / str(most)
        done = record(short, out, tables={}, most_worlds=most)
        assert done.episodes == 3
        assert done.failures > 0  # else the numbers of the attempts say nothing
        recorded.append({path.name: read_episode(path) for path in recordings_in([out])})
    alone, together = recorded
    assert list(alone) == list(together)
    for name, episode in alone.items():
        np.testing.assert_array_equal(episode.sim_states, together[name].sim_states)
        np.testing.assert_array_equal(episode.actions, together[name].actions)


def test_too_many_failures_end_the_recording_and_keep_the_successes(short, tmp_path) -> None:
    hopeless = replace(short, max_seconds=0.5, attempts_per_episode=2)
    with pytest.raises(LfdError, match="6 of 6 attempts failed; 0 demonstrations are in"):
        record(hopeless, tmp_path / "out", tables={})
