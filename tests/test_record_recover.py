"""That a crash loses no step that was recorded: a real recording is killed, again and again."""

import os
import random
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lfd.core.errors import RecordingError
from lfd.record.episode_file import read_episode
from lfd.record.recover import recover
from lfd.replay.verify import verify_episode
from tests.test_record_episode_file import record_steps

STEPS, HZ = 150, 20
RECORDER = f"""
import os, sys
from pathlib import Path
import numpy as np
from lfd.experts.playback import PlaybackPolicy
from lfd.record.episode_file import McapRecorder, Origin
from lfd.worlds.robosuite_world import make_world
from lfd.worlds.rollout import rollout

class Say:
    def begin(self, world, seen): pass
    def step(self, world, transition): print("step", transition.step, flush=True)
    def end(self, success): print("ended", flush=True)
    def abort(self): pass

world = make_world("Lift", "panda", {HZ})
print("ready", flush=True)
for folder in sys.stdin:
    child = os.fork()
    if child == 0:
        for index in range(10**6):
            rng = np.random.default_rng(index)
            actions = rng.uniform(-0.3, 0.3, ({STEPS}, 7))
            origin = Origin(stage="record", policy="test", seed=0, index=index, recipe={{}})
            path = Path(folder.strip()) / f"episode_{{index:06d}}.mcap"
            recorder = McapRecorder(path, origin, keep_failures=True)
            rollout(world, PlaybackPolicy(actions), [recorder, Say()], rng, horizon={STEPS}, hold_steps={STEPS + 1})
    print("child", child, flush=True)
    os.waitpid(child, 0)
    print("killed", flush=True)
"""


@pytest.fixture(scope="module")
def recorder() -> Iterator[subprocess.Popen[str]]:
    """A process that starts a recording process for every folder it is told."""
    process = subprocess.Popen(
        [sys.executable, "-c", RECORDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        text=True,
    )  # fmt: skip
    assert process.stdout is not None
    while process.stdout.readline().strip() != "ready":
        assert process.poll() is None
    yield process
    process.kill()
    process.communicate()


def record_until_killed(recorder: subprocess.Popen[str], folder: Path, moment: int) -> tuple[int, int]:
    """Kill a recording when it has told of `moment` steps; episodes that ended, and steps of the running one."""
    assert recorder.stdin is not None
    assert recorder.stdout is not None
    folder.mkdir()
    recorder.stdin.write(f"{folder}\n")
    recorder.stdin.flush()
    ended = steps = told = child = 0
    for line in recorder.stdout:
        word, _, number = line.strip().partition(" ")
        if word == "child":
            child = int(number)
        elif word == "step":
            steps, told = int(number) + 1, told + 1
        elif word == "ended":
            ended, steps = ended + 1, 0
        elif word == "killed":
            break
        if child and told >= moment:
            os.kill(child, signal.SIGKILL)
            child = 0
    return ended, steps


def test_a_killed_recording_loses_not_even_a_step(recorder, tmp_path) -> None:
    chance = random.Random(0)
    for number in range(20):
        folder = tmp_path / str(number)
        ended, steps = record_until_killed(recorder, folder, chance.randrange(1, 3 * STEPS))
        finished = sorted(folder.glob("*.mcap"))
        assert len(finished) >= ended  # the last word of an ended episode may not have been heard
        for path in finished:
            assert len(read_episode(path)) == STEPS
        unfinished = list(folder.glob("*.part"))
        assert len(unfinished) <= 1
        done = recover(folder)
        assert list(folder.glob("*.part")) == [] or not done[0].episode
        saved = done[0].steps if done else 0
        running = steps if len(finished) == ended else 0
        assert running - saved <= 0, f"{running} steps were told of, {saved} saved"
        if saved:
            episode = read_episode(Path(done[0].episode))
            assert len(episode) == saved
            assert episode.metadata.recovered.startswith("cut off")
            assert not episode.successes[-1]


def test_a_recovered_episode_replays_without_deviation(recorder, tmp_path) -> None:
    record_until_killed(recorder, tmp_path / "killed", 100)
    (done,) = recover(tmp_path / "killed")
    episode = read_episode(Path(done.episode))
    assert verify_episode(episode).deviation == 0
    np.testing.assert_allclose(episode.times, np.arange(len(episode) + 1) / HZ, atol=1e-9)


def test_a_flipped_bit_costs_the_steps_of_its_chunk(lift_world, tmp_path, rng) -> None:
    path = tmp_path / "episode.mcap"
    record_steps(lift_world, path, rng.uniform(-0.3, 0.3, (260, 7)))
    whole, good = read_episode(path), path.read_bytes()
    chunks = [match.start() for match in re.finditer(b"\x04\0\0\0zstd", good)]
    damaged = bytearray(good)
    damaged[chunks[2] + 60] ^= 4
    path.write_bytes(damaged)
    with pytest.raises(RecordingError, match="save what is whole with `lfd recover"):
        read_episode(path)
    (done,) = recover(tmp_path)
    assert (tmp_path / "episode.mcap.damaged").read_bytes() == damaged
    episode = read_episode(path)
    assert len(episode) == done.steps > 100
    assert done.dropped_steps > 0
    begin = int(np.flatnonzero((whole.actions == episode.actions[0]).all(axis=1))[0])
    np.testing.assert_array_equal(episode.actions, whole.actions[begin : begin + len(episode)])
    np.testing.assert_array_equal(
        episode.observations["ee_pos"], whole.observations["ee_pos"][begin : begin + len(episode) + 1]
    )
    assert episode.start_memory is None
    assert recover(tmp_path) == []  # nothing is left to do


def test_what_cannot_be_saved_is_said_and_kept(tmp_path, rng) -> None:
    (tmp_path / "episode_000000.mcap.part").write_bytes(rng.bytes(3000))
    (tmp_path / "episode_000001.mcap.part").write_bytes(b"")
    done = recover(tmp_path)
    assert [row.episode for row in done] == ["", ""]
    assert "holds nothing that can be saved" in done[0].note
    assert len(list(tmp_path.iterdir())) == 2
    with pytest.raises(RecordingError, match="no folder"):
        recover(tmp_path / "gone")
