"""A person at a real terminal: keys go in at one end of a pty, recordings come out on the disk."""

import json
import os
import re
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfd.core.errors import OutputError
from lfd.core.protocols import World
from lfd.core.recipe import build, load_toml
from lfd.experts.device import DeviceState
from lfd.experts.keys import Word
from lfd.record.demonstrations import RecordRecipe
from lfd.record.episode_file import read_episode, recordings_in
from lfd.record.mcap_file import read_mcap
from lfd.record.session import Session, record_session
from lfd.replay.verify import verify_episode
from lfd.worlds.rollout import episode_rng
from tests.conftest import LIFT, ROOT

LINES = ["/teleop/axes", "/pace"]


@pytest.fixture
def recipe() -> RecordRecipe:
    made = build(RecordRecipe, load_toml(LIFT, ["record", "convert"])["record"], "recipe")
    return replace(made, control_hz=50, episodes=9, max_seconds=2.0)


def words(*said: Word | float | None) -> Iterator[DeviceState]:
    """States of a device that says words, pushes away (a number), or neither."""
    for one in said:
        move = np.array([one, 0.0, 0.0]) if isinstance(one, float) else np.zeros(3)
        said_now = (one,) if isinstance(one, Word) else ()
        yield DeviceState(translation=move, rotation=np.zeros(3), words=said_now)


class Told:
    """A device that says what it is told, then quits."""

    name = "told"

    def __init__(self, *said: Word | float | None):
        self._states = words(*said)

    def read(self) -> DeviceState:
        return next(self._states, next(words(Word.QUIT)))


class Shown:
    """A view that remembers the starts that it showed."""

    def __init__(self) -> None:
        self.starts: list[np.ndarray] = []

    def show(self, world: World) -> None:
        self.starts.append(world.sim_state())

    def begin(self, world, observation) -> None: ...

    def step(self, world, transition) -> None: ...

    def end(self, success) -> None: ...

    def abort(self) -> None: ...


def run(recipe: RecordRecipe, out: Path, *said: Word | float | None, **options) -> tuple[Session, list[str]]:
    told: list[str] = []
    options.setdefault("status", lambda state, detail: told.append(f"{state} {detail}"))
    session = record_session(recipe, out, Told(*said), tables={"record": {}}, **options)
    return session, told


def test_words_decide_what_is_kept(recipe, tmp_path) -> None:
    out, view = tmp_path / "out", Shown()
    said = [
        *(None, Word.START, 1.0, None, Word.SUCCESS),
        *(Word.START, 1.0, Word.REDO),
        *(None, Word.START, Word.FAILURE),
        *(Word.START, None, Word.DISCARD),
        *(Word.START, Word.SUCCESS),
        *(Word.START, None, Word.QUIT),
    ]
    session, told = run(recipe, out, *said, view=view)
    assert (session.successes, session.failures, session.discarded, session.redone) == (2, 1, 2, 1)
    episodes = {path.name: read_episode(path) for path in recordings_in([out])}
    assert list(episodes) == ["episode_000000.mcap", "episode_000001.mcap", "episode_000003.mcap"]
    assert [len(episode) for episode in episodes.values()] == [3, 1, 1]
    ends = [json.loads(read_mcap(out / name).metadata["lfd.episode_end"]["success"]) for name in episodes]
    assert ends == [True, False, True]
    assert not list(out.glob("*.part"))
    assert any("success.  1 of 9 recorded, 0 failures" in line for line in told)
    starts = [episode.sim_states[0] for episode in episodes.values() if episode.sim_states is not None]
    np.testing.assert_array_equal(view.starts[1], view.starts[2])  # redo: the same again
    for index, start in zip((0, 1, 4), starts, strict=True):
        np.testing.assert_array_equal(view.starts[index], start)


def test_an_episode_has_the_start_of_its_number_and_replays_exactly(recipe, lift_world, tmp_path) -> None:
    run(recipe, tmp_path / "out", Word.START, *[0.5] * 20, Word.GRIPPER, *[None] * 5, Word.SUCCESS)
    episode = read_episode(tmp_path / "out" / "episode_000000.mcap")
    first = lift_world.reset(episode_rng("record", recipe.seed, 0))
    for name, values in first.items():
        np.testing.assert_array_equal(episode.observations[name][0], values)
    assert verify_episode(episode).deviation == 0.0
    assert (episode.metadata.policy, episode.metadata.stage, episode.metadata.index) == ("told", "record", 0)
    assert episode.metadata.recipe["teleop"]["frame"] == "view"
    np.testing.assert_array_equal(episode.expert_actions, episode.actions)
    topics = read_mcap(tmp_path / "out" / "episode_000000.mcap").messages
    for topic in LINES:
        assert len(topics[topic]) == len(episode)


def test_time_that_is_up_is_a_failure_with_advice(recipe, tmp_path) -> None:
    session, told = run(replace(recipe, max_seconds=0.2), tmp_path / "out", Word.START, *[None] * 12)
    assert (session.failures, session.steps) == (1, 10)
    assert any("failure: 0.2 s are over; --set record.max_seconds=60 gives more" in line for line in told)


def test_a_session_ends_when_enough_succeeded(recipe, tmp_path) -> None:
    said = [Word.START, Word.FAILURE, *[Word.START, Word.SUCCESS] * 3]
    session, _ = run(replace(recipe, episodes=2), tmp_path / "out", *said)
    assert (session.successes, session.failures) == (2, 1)


def test_a_session_goes_on_after_what_the_folder_holds(recipe, tmp_path) -> None:
    out = tmp_path / "out"
    run(recipe, out, Word.START, None, Word.SUCCESS, Word.START, Word.SUCCESS)
    before = {path.name: path.read_bytes() for path in recordings_in([out])}
    (out / "episode_000004.mcap.part").write_bytes(b"what a crash left")
    run(recipe, out, Word.START, Word.SUCCESS, resume=True)
    assert [path.name for path in recordings_in([out])] == [*before, "episode_000005.mcap"]
    assert {name: (out / name).read_bytes() for name in before} == before
    with pytest.raises(OutputError, match="was recorded with seed = 0, the recipe says 1; go on with the same recipe"):
        run(replace(recipe, seed=1), out, resume=True)
    with pytest.raises(OutputError, match="exists already"):
        run(recipe, out)
    with pytest.raises(OutputError, match="holds no recordings to go on with; leave --resume out"):
        run(recipe, tmp_path / "none", resume=True)


def test_an_error_leaves_finished_episodes_and_nothing_else(recipe, tmp_path) -> None:
    class Unplugged(Told):
        def read(self) -> DeviceState:
            state = next(self._states, None)
            if state is None:
                raise KeyboardInterrupt
            return state

    device = Unplugged(Word.START, None, Word.SUCCESS, Word.START, None)
    with pytest.raises(KeyboardInterrupt):
        record_session(recipe, tmp_path / "out", device, tables={}, status=lambda state, detail: None)
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert left == ["episode_000000.mcap", "manifest.json"]


def _at_a_terminal() -> None:
    """Make the terminal on standard input the process' own, and Ctrl-C heard: shells ignore it in background jobs."""
    os.close(os.open(os.ttyname(0), os.O_RDWR))
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Person:
    """Sits at the terminal of an `lfd record --device keyboard` in a process of its own."""

    def __init__(self, *arguments: str):
        self._here, there = os.openpty()
        self.before = termios.tcgetattr(there)
        os.set_blocking(self._here, False)
        self._there, self.seen = there, ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "lfd.cli", "record", str(LIFT), "--device", "keyboard", "--json", *arguments],
            cwd=ROOT,
            stdin=there,
            stdout=subprocess.PIPE,
            stderr=there,
            text=True,
            start_new_session=True,
            preexec_fn=_at_a_terminal,
            env={name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")},
        )

    def sees(self, pattern: str) -> re.Match[str]:
        """Wait for a text on the terminal, and forget what stood before it."""
        deadline = time.monotonic() + 60
        while (found := re.search(pattern, self.seen)) is None:
            assert time.monotonic() < deadline, self.seen[-500:]
            assert self.process.poll() is None, self.seen[-500:]
            time.sleep(0.02)
            try:
                self.seen += os.read(self._here, 65536).decode()
            except BlockingIOError:
                continue
        self.seen = self.seen[found.end() :]
        return found

    def types(self, keys: str, *, seconds: float = 0.0) -> None:
        """Press keys, and hold the last one down for some time, as a terminal repeats it."""
        ends = time.monotonic() + seconds
        os.write(self._here, keys.encode())
        while time.monotonic() < ends:
            time.sleep(0.04)
            os.write(self._here, keys[-1].encode())

    def leaves(self) -> tuple[int, str]:
        """Exit code and standard output, once the process has ended and the terminal is as it was."""
        output, _ = self.process.communicate(timeout=60)
        assert termios.tcgetattr(self._there) == self.before
        return self.process.returncode, output

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        for descriptor in (self._here, self._there):
            os.close(descriptor)


@pytest.fixture
def sit_down() -> Iterator[Callable[..., Person]]:
    """Starts a person's `lfd record`; whatever goes wrong, none is left running."""
    with ExitStack() as stack:
        yield lambda *arguments: stack.enter_context(closing(Person(*arguments)))


@pytest.mark.slow
def test_a_person_records_through_a_terminal(sit_down, tmp_path, record_property) -> None:
    out = tmp_path / "mine"
    person = sit_down("--out", str(out), "--set", "record.max_seconds=60")
    address = person.sees(r"live view: (http://127\.0\.0\.1:\d+)")[1]
    person.sees("episode 0: waiting.*Enter starts")
    person.types("\n")
    person.sees("episode 0: moving")
    person.types("f", seconds=1.0)
    person.types(" ")
    person.types("a", seconds=0.5)
    person.types("y")
    person.sees("episode 1: waiting  success.  1 of 50")
    assert read_episode(out / "episode_000000.mcap")  # whole before the next begins
    person.types("\n")
    person.sees("episode 1: moving")
    person.types("z")
    person.sees("episode 1: waiting  again.")
    person.types("\n")
    person.sees("episode 1: moving")
    person.types("x")
    person.sees("episode 2: waiting  discarded.")
    person.types("\n")
    person.sees("episode 2: moving")
    person.types("n")
    person.sees("episode 3: waiting  failure.  1 of 50 recorded, 1 failures")
    person.types("q")
    code, output = person.leaves()
    assert code == 0
    told = json.loads(output)
    assert (told["successes"], told["failures"], told["discarded"], told["redone"]) == (1, 1, 1, 1)
    for name, value in told["pace"].items():
        record_property(name, value)
    print(told["pace"])
    assert [path.name for path in recordings_in([out])] == ["episode_000000.mcap", "episode_000002.mcap"]
    assert subprocess.run(["curl", "-s", address], capture_output=True, check=False).returncode != 0
    episode = read_episode(out / "episode_000000.mcap")
    assert episode.metadata.policy == "keyboard"
    assert episode.observations["ee_pos"][-1][2] < episode.observations["ee_pos"][0][2] - 0.03  # f is down
    assert episode.observations["ee_pos"][-1][1] < episode.observations["ee_pos"][0][1] - 0.01  # left of who faces it
    assert set(episode.actions[:, -1]) == {-1.0, 1.0}
    assert verify_episode(episode).deviation == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_ends_the_process_restores_the_terminal(number, sit_down, tmp_path) -> None:
    out = tmp_path / "mine"
    person = sit_down("--out", str(out), "--no-view")
    person.sees("episode 0: waiting")
    person.types("\n")
    person.sees("episode 0: moving")
    os.kill(person.process.pid, number)
    code, _ = person.leaves()
    assert code == (1 if number == signal.SIGINT else 128 + number)
    assert [path.name for path in out.iterdir()] == ["manifest.json"]


def test_a_person_moves_one_robot(lfd_fails, tmp_path) -> None:
    record = ("record", LIFT, "--out", tmp_path / "out")
    for options in (("--worlds", "2"), ("--cluster",)):
        error = lfd_fails(*record, "--device", "keyboard", *options)
        assert f"a person moves one robot at a time: leave out {options[0]}" in error
    assert "unknown device 'keybord'; known: gamepad, keyboard, spacemouse" in lfd_fails(*record, "--device", "keybord")
    assert "--no-view is for people" in lfd_fails(*record, "--no-view")
    assert not (tmp_path / "out").exists()
