from typing import Any

import numpy as np
import pytest

from lfd.core.episode import Episode, EpisodeMetadata
from lfd.core.errors import EpisodeError

METADATA = EpisodeMetadata(
    task="Lift", instruction="lift", robot="panda", controller="OSC_POSE", policy="test", control_hz=20,
    stage="record", seed=0, index=0, stepper="robosuite", started="", versions={}, recipe={},
)  # fmt: skip


def fields(steps: int = 3) -> dict[str, Any]:
    return {
        "times": np.arange(steps + 1) / 20,
        "observations": {"ee_pos": np.zeros((steps + 1, 3))},
        "actions": np.zeros((steps, 2)),
        "rewards": np.zeros(steps),
        "successes": np.array([False] * (steps - 1) + [True]),
        "interventions": np.zeros(steps, dtype=bool),
        "labels": {"ee_pos": ("x", "y", "z"), "action": ("a", "b")},
        "metadata": METADATA,
    }


def test_an_episode_is_frozen() -> None:
    episode = Episode(**fields())
    assert len(episode) == 3
    assert episode.success
    with pytest.raises(ValueError, match="read-only"):
        episode.actions[0, 0] = 1.0
    with pytest.raises(TypeError):
        episode.observations["ee_pos"] = np.zeros(1)  # type: ignore[index]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.zeros((0, 2))}, "at least one step"),
        ({"rewards": np.zeros(4)}, "channel 'reward' has 4 rows, 3 actions need 3"),
        ({"observations": {"ee_pos": np.zeros((3, 3))}}, "channel 'ee_pos' has 3 rows, 3 actions need 4"),
        ({"observations": {"ee_pos": np.full((4, 3), np.nan)}}, "channel 'ee_pos' is not finite at step 0"),
        ({"actions": np.array([[0, 0], [0, np.inf], [0, 0.0]])}, "channel 'action' is not finite at step 1"),
        ({"times": np.array([0, 0.05, 0.05, 0.1])}, "time does not increase at step 2"),
        ({"labels": {"ee_pos": ("x",), "action": ("a", "b")}}, "has 3 components, its labels name 1"),
        ({"labels": {"cube_pos": ("x",)}}, "channel 'cube_pos' is missing"),
    ],
)
def test_numbers_that_are_no_episode(change: dict[str, Any], message: str) -> None:
    with pytest.raises(EpisodeError, match=message):
        Episode(**{**fields(), **change})
