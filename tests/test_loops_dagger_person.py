import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.data.frames import load_frames
from lfd.experts.keys import Word
from lfd.loops.dagger import dagger
from lfd.loops.dagger_person import Person
from lfd.loops.dagger_round import round_folder
from lfd.record.episode_file import read_episode
from tests.test_loops_dagger import recipes
from tests.test_record_session import Shown, Told

PERSON = ("dagger.gate=human", "dagger.demonstrations=1", "dagger.gate_rest_seconds=0.1")
FAST = ("record.max_seconds=4.0", "record.control_hz=50")
DEMONSTRATION = (Word.START, 1.0, 0.5, None, Word.SUCCESS)


def person(*said: Word | float | None, told: list[str] | None = None) -> Person:
    lines = [] if told is None else told
    return Person(device=Told(*said), view=Shown(), status=lambda state, detail: lines.append(f"{state} {detail}"))


def test_a_person_demonstrates_takes_over_and_hands_back(tmp_path) -> None:
    out, told = tmp_path / "loop", []
    looked_after = [
        *(Word.START, None, None, 1.0, 1.0, Word.HAND_BACK, None, Word.SUCCESS),
        *(Word.START, 0.5, Word.DISCARD),
        *(Word.START, None, Word.TAKE_OVER, None, None, None, None, None, None, Word.FAILURE),
    ]
    report = dagger(recipes(*PERSON, data=FAST), out, person=person(*DEMONSTRATION, *looked_after, told=told))
    folder = round_folder(out, 1) / "recordings"
    assert sorted(path.name for path in folder.glob("*.mcap")) == ["episode_000000.mcap", "episode_000002.mcap"]
    first, second = (read_episode(folder / f"episode_00000{number}.mcap") for number in (0, 2))
    np.testing.assert_array_equal(first.interventions, [0, 0, 1, 1, 0, 0, 0])
    np.testing.assert_array_equal(second.interventions, [0, 1, 1, 1, 1, 1, 0, 0, 0])  # 0.1 s of rest are 5 steps
    for episode in (first, second):
        assert episode.expert_actions is not None
        np.testing.assert_array_equal(np.isfinite(episode.expert_actions[:, 0]), episode.interventions)
    rows = report["rounds"]
    assert [row["labels"] for row in rows] == [4, 7]
    assert [row["takeovers"] for row in rows] == [1, 2]
    assert len(load_frames(out / "dataset", images=False)) == 11
    assert any("1 of 2 recorded, 0 failures" in line for line in told)


def test_quitting_keeps_what_is_recorded_and_resuming_asks_for_the_rest(tmp_path) -> None:
    out, made = tmp_path / "loop", recipes(*PERSON, data=FAST)
    with pytest.raises(InputError, match="--resume goes on"):
        dagger(made, out, person=person(*DEMONSTRATION, Word.START, 1.0, Word.SUCCESS))
    assert len(list((round_folder(out, 1) / "recordings").glob("*.mcap"))) == 1
    report = dagger(made, out, person=person(Word.START, 1.0, Word.SUCCESS), resume=True)
    assert [row["episodes"] for row in report["rounds"]] == [1, 2]


def test_a_person_and_their_gate_belong_together(lfd_fails, tmp_path) -> None:
    with pytest.raises(InputError, match="--device keyboard"):
        dagger(recipes(*PERSON, data=FAST), tmp_path / "out")
    with pytest.raises(InputError, match="--device keyboard"):
        dagger(recipes(data=FAST), tmp_path / "out", person=person())
    said = lfd_fails("dagger", "policies/dagger_lift.toml", "--no-view", "--out", str(tmp_path / "out"))
    assert "--no-view is for people" in said
    assert not (tmp_path / "out").exists()
