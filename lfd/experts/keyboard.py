"""The keyboard of a terminal as a device; works over SSH.

A terminal tells presses, repeated while a key is down, and never a release. A key therefore counts as held for
`HELD_S` after each press: a tap is a small move, a key held down moves on after the terminal's repeat delay. Only the
key pressed last repeats. Terminals send nothing at all for modifiers alone, hence one letter a direction.
"""

import os
import re
import select
import signal
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import inf
from types import FrameType

from lfd.core.errors import InputError, LfdError
from lfd.experts.device import DeviceState, pushed
from lfd.experts.keys import MOVES, WORDS, Word

HELD_S = 0.15
"""How long a key counts as held after a press [s]; terminals repeat every 0.03 to 0.1 s, networks add to that."""
REPEAT_S = 0.7
"""How long a press of the same key counts as its repetition [s]; the first comes after 0.25 to 0.66 s."""
REPEATABLE = (Word.SLOWER, Word.FASTER, Word.START)
"""Words that a key held down may say again and again."""
KEY = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]|\x1bO.|[^\x1b]|\x1b(?=.)(?![\[O])", re.DOTALL)
"""One key: a control sequence such as an arrow's, or a character."""


class Keyboard:
    """Reads the keys that arrive at a terminal's file descriptor, which must be in a mode that passes them on."""

    name = "keyboard"

    def __init__(self, descriptor: int, clock: Callable[[], float] = time.monotonic):
        self._descriptor, self._clock = descriptor, clock
        self._unread = ""
        self._seen: dict[str, float] = {}

    def read(self) -> DeviceState:
        now, words = self._clock(), []
        for key in self._pressed():
            word, before = WORDS.get(key), self._seen.get(key, -inf)
            if word is not None and (now - before > REPEAT_S or word in REPEATABLE):
                words.append(word)
            self._seen[key] = now
        return pushed((MOVES[key] for key in MOVES if now - self._seen.get(key, -inf) <= HELD_S), words)

    def _pressed(self) -> list[str]:
        """The keys since the last reading; the beginning of a control sequence waits for its end."""
        while select.select([self._descriptor], [], [], 0)[0]:
            arrived = os.read(self._descriptor, 1024)
            if not arrived:
                raise LfdError("the terminal was closed; finished episodes are kept, --resume goes on after them")
            self._unread += arrived.decode(errors="replace")
        keys, end = [], 0
        for match in KEY.finditer(self._unread):
            if match.start() != end:
                break
            keys.append(match.group())
            end = match.end()
        self._unread = self._unread[end:]
        return [key if key in MOVES else key.lower() for key in keys]  # Caps Lock moves the robot, too


@contextmanager
def open_keyboard() -> Iterator[Keyboard]:
    """The keyboard of the terminal that this process belongs to, whatever its input and output are redirected to.

    Raises `InputError` where there is none.
    """
    try:
        descriptor = os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY)
    except OSError as error:
        raise InputError(
            f"no terminal to read keys from ({error.strerror}); run lfd in a terminal, over SSH with `ssh -t HOST`"
        ) from error
    try:
        with single_keys(descriptor):
            yield Keyboard(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def single_keys(descriptor: int) -> Iterator[None]:
    """Have a terminal pass on each key at once and unseen, and restore it however the block is left.

    Ctrl-C still interrupts. Ctrl-Z does not stop: a robot that is being moved cannot wait. A closed connection or
    `kill` end the process as Ctrl-C would, with everything put back.
    """
    before = termios.tcgetattr(descriptor)
    handlers = {number: signal.signal(number, _leave) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        tty.setcbreak(descriptor)
        mode = termios.tcgetattr(descriptor)
        mode[6][termios.VSUSP] = b"\x00"
        termios.tcsetattr(descriptor, termios.TCSADRAIN, mode)
        yield
    finally:
        with suppress(termios.error):  # a terminal that is gone needs no restoring
            termios.tcsetattr(descriptor, termios.TCSAFLUSH, before)  # unread keys are not for the shell
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _leave(number: int, _: FrameType | None) -> None:
    raise SystemExit(128 + number)
