"""A real terminal: what is written to one end of a pty is typed at the other."""

import os
import signal
import subprocess
import sys
import termios

import numpy as np
import pytest

from lfd.core.errors import LfdError
from lfd.experts.keyboard import HELD_S, REPEAT_S, Keyboard, single_keys
from lfd.experts.keys import ACTING, DOWN, HELP, LEFT, MOVES, WAITING, WORDS, Word


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def terminal():
    """Both ends of a terminal: the person's and the program's."""
    person, program = os.openpty()
    yield person, program
    for descriptor in (person, program):
        os.close(descriptor)


@pytest.fixture
def typing(terminal):
    """Types at a terminal whose keyboard is read."""
    person, program = terminal
    clock = Clock()
    with single_keys(program):
        keyboard = Keyboard(program, clock)

        def state(typed: str, after: float = 0.0):
            clock.now += after
            os.write(person, typed.encode())
            return keyboard.read()

        yield state


def test_a_key_is_held_for_a_short_time_after_each_repetition(typing) -> None:
    np.testing.assert_array_equal(typing("w").translation, [1, 0, 0])
    np.testing.assert_array_equal(typing("", HELD_S * 0.9).translation, [1, 0, 0])
    np.testing.assert_array_equal(typing("", HELD_S * 0.2).translation, [0, 0, 0])
    for _ in range(20):  # held down: the terminal repeats it
        np.testing.assert_array_equal(typing("w", 0.1).translation, [1, 0, 0])


def test_keys_held_together_add_up_and_opposite_ones_cancel(typing) -> None:
    state = typing("wafuk")
    np.testing.assert_array_equal(state.translation, [1, 1, -1])
    np.testing.assert_array_equal(state.rotation, [0, -1, 1])
    np.testing.assert_array_equal(typing("s").translation, [0, 1, -1])


def test_every_direction_has_a_key_for_both_ways() -> None:
    assert {(axis, sign) for axis, sign in MOVES.values()} == {
        (a, s) for a in ("x", "y", "z", "rx", "ry", "rz") for s in (1, -1)
    }


def test_a_word_is_said_once_however_long_its_key_is_held(typing) -> None:
    assert typing(" ").words == (Word.GRIPPER,)
    for pause in (0.5, 0.03, 0.03):
        assert typing(" ", pause).words == ()
    assert typing(" ", REPEAT_S * 1.1).words == (Word.GRIPPER,)
    assert typing("==\n\n").words == (Word.FASTER, Word.FASTER, Word.START, Word.START)  # harmless


def test_words_arrive_in_the_order_of_their_keys(typing) -> None:
    assert typing("\n -q").words == (Word.START, Word.GRIPPER, Word.SLOWER, Word.QUIT)


def test_arrow_keys_move_and_their_letters_are_no_keys(typing) -> None:
    state = typing(LEFT + DOWN)
    np.testing.assert_array_equal(state.translation, [-1, 1, 0])
    np.testing.assert_array_equal(state.rotation, [0, 0, 0])


def test_a_sequence_may_arrive_in_pieces_and_unknown_ones_do_nothing(typing) -> None:
    assert not typing("\x1b").translation.any()
    assert not typing("[").translation.any()
    np.testing.assert_array_equal(typing("A").translation, [1, 0, 0])
    state = typing("\x1b[15~\x1bOP\x1b[1;5Dé", 1.0)
    assert not state.translation.any()
    assert not state.rotation.any()
    assert state.words == ()


def test_caps_lock_changes_nothing(typing) -> None:
    state = typing("WY")
    np.testing.assert_array_equal(state.translation, [1, 0, 0])
    assert state.words == (Word.SUCCESS,)


def test_the_terminal_is_restored_also_after_an_error(terminal) -> None:
    _, program = terminal
    before = termios.tcgetattr(program)
    during = None

    def interrupted() -> None:
        nonlocal during
        with single_keys(program):
            during = termios.tcgetattr(program)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert during != before
    assert termios.tcgetattr(program) == before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_the_terminal_is_restored_when_the_process_is_ended(number, terminal) -> None:
    _, program = terminal
    before = termios.tcgetattr(program)
    code = (
        "import os, time\n"
        "from lfd.experts.keyboard import single_keys\n"
        "with single_keys(0):\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=program, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        assert termios.tcgetattr(program) != before
        os.kill(process.pid, number)
        assert process.wait(10) == 128 + number
    assert termios.tcgetattr(program) == before


def test_a_closed_terminal_is_an_error() -> None:
    read, write = os.pipe()
    os.close(write)
    with pytest.raises(LfdError, match="the terminal was closed; finished episodes are kept"):
        Keyboard(read).read()
    os.close(read)


def test_without_a_terminal_the_way_out_is_named() -> None:
    code = "from lfd.experts.keyboard import open_keyboard\nwith open_keyboard(): pass"
    done = subprocess.run(
        [sys.executable, "-c", code], start_new_session=True, capture_output=True, text=True, check=False
    )
    assert "InputError: no terminal to read keys from" in done.stderr
    assert "ssh -t HOST" in done.stderr


def test_the_help_names_every_key() -> None:
    shown = {"\n": "Enter", "\r": "Enter", " ": "space", "+": "=", "\x1b[A": "up", "\x1b[B": "down"}
    shown |= {"\x1b[C": "right", "\x1b[D": "left"}
    for key in (*MOVES, *WORDS):
        assert f" {shown.get(key, key)} " in HELP.replace("\n", " "), key
    for key, word in WORDS.items():
        if word in (Word.SUCCESS, Word.FAILURE, Word.DISCARD, Word.REDO, Word.QUIT):
            assert f"{key} {word}" in ACTING
    assert "Enter starts" in WAITING
