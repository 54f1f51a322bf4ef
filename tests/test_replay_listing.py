import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfd.core.artifact import write_manifest
from lfd.core.errors import InputError
from lfd.loops.replaying import listing
from lfd.record.episode_file import read_episode, recordings_in
from lfd.record.episode_writing import write_episode
from lfd.replay.clip import EXPERT, POLICY, SOLVED, UNSOLVED, WHO_ACTS, episode_clip
from lfd.replay.listing import numbers_of
from tests.conftest import call_json


def test_numbers_and_ranges() -> None:
    assert numbers_of("0,3,7-9") == (0, 3, 7, 8, 9)
    for text in ("", "1,", "a", "-1", "3-1", "1,1", "0-2,2", "0-9999"):
        with pytest.raises(InputError, match="--episodes"):
            numbers_of(text)


def test_what_the_thread_made_is_listed_with_its_outcomes(thread) -> None:
    recorded, converted, evaluated = (listing(path) for path in (thread.recordings, thread.dataset, thread.run))
    assert [found.kind for found in (recorded, converted, evaluated)] == ["recordings", "dataset", "evaluation"]
    for found in (recorded, converted):
        assert [entry.succeeded() for entry in found.entries] == [True, True]
    successes = [entry.succeeded() for entry in evaluated.entries]
    assert sum(success is True for success in successes) == thread.printed["eval"]["successes"]
    for entry in evaluated.entries:
        (clip,) = entry.open()
        assert clip.success == entry.succeeded()
        assert clip.title == entry.title
        assert clip.about["outcome"] == (SOLVED if clip.success else UNSOLVED)
    printed = call_json(["replay", str(thread.run), "--list"])
    assert [row["success"] for row in printed["episodes"]] == successes


def dagger_run(out: Path, recordings: Path) -> Path:
    """Two rounds of a DAgger run, in the second of which the expert took over for some steps."""
    first, second = (read_episode(path) for path in recordings_in([recordings]))
    for number in (0, 1):
        (out / f"round_{number:03d}" / "recordings").mkdir(parents=True)
    write_manifest(out, kind="dagger", recipe={}, parents={}, seed=0)
    shutil.copy(recordings_in([recordings])[0], out / "round_000" / "recordings" / "episode_000000.mcap")
    overruled = np.zeros(len(second), dtype=bool)
    overruled[5:9] = overruled[20:] = True
    write_episode(out / "round_001" / "recordings" / "episode_000000.mcap", replace(second, interventions=overruled))
    write_episode(out / "round_001" / "recordings" / "episode_000001.mcap", first)
    return out


def test_a_round_shows_who_acted(thread, tmp_path) -> None:
    out = dagger_run(tmp_path / "dagger", thread.recordings)
    assert [entry.title for entry in listing(out).entries] == [
        "round_000/episode_000000.mcap",
        "round_001/episode_000000.mcap",
        "round_001/episode_000001.mcap",
    ]
    found = listing(out, 1)
    assert len(found.entries) == 2
    (clip,) = found.entries[0].open()
    times = clip.times
    assert clip.states[WHO_ACTS] == (
        (times[0], POLICY),
        (times[5], EXPERT),
        (times[9], POLICY),
        (times[20], EXPERT),
    )
    pieces = clip.pieces["ee_overruled"]
    np.testing.assert_array_equal(pieces[0], clip.positions["ee"][5:10])
    np.testing.assert_array_equal(pieces[1], clip.positions["ee"][20:])
    (other,) = found.entries[1].open()
    assert WHO_ACTS not in other.states
    assert other.pieces == {}


def test_the_lane_of_the_task_changes_where_it_is_solved(thread) -> None:
    episode = read_episode(recordings_in([thread.recordings])[0])
    clip = episode_clip(episode, "x")
    first = int(np.argmax(episode.successes))
    assert clip.states["task"][0] == (0.0, UNSOLVED)
    assert clip.states["task"][1] == (episode.times[first + 1], SOLVED)


def test_bad_input_says_what_to_type(thread, tmp_path, lfd_fails) -> None:
    out = dagger_run(tmp_path / "dagger", thread.recordings)
    save = ("--save", tmp_path / "x.rrd")
    assert "rounds 0, 1, not of 7" in lfd_fails("replay", out, "--round", "7", *save)
    assert "leave out --round" in lfd_fails("replay", thread.run, "--round", "1", *save)
    assert f"lfd eval {thread.policy} --out RUN" in lfd_fails("replay", thread.policy, *save)
    assert "--list names them" in lfd_fails("replay", thread.run, "--episodes", "0,9", *save)
    assert "write for example 0,3,7-9" in lfd_fails("replay", thread.run, "--episodes", "one", *save)
    assert "choose with --episodes 0,3,7" in lfd_fails("replay", thread.run, "--beside", *save)
    assert "choose it with --episode" in lfd_fails("replay", thread.run, "--all", "--verify")
    for name, told in (("a.rrd", "rerun "), ("a.hdf5", "lfd convert"), ("a.txt", "give a recording")):
        (tmp_path / name).write_bytes(b"")
        assert told in lfd_fails("replay", tmp_path / name, *save)
    reward = tmp_path / "reward"
    reward.mkdir()
    write_manifest(reward, kind="reward", recipe={}, parents={}, seed=0)
    assert f"lfd plan {reward} --out PLANS" in lfd_fails("replay", reward, *save)
    empty = tmp_path / "empty"
    empty.mkdir()
    write_manifest(empty, kind="dagger", recipe={}, parents={}, seed=0)
    assert "holds no .mcap file" in lfd_fails("replay", empty, *save)
    assert not (tmp_path / "x.rrd").exists()
