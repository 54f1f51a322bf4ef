"""What a person can say with a device, and the keys of the keyboard that say it.

No library is needed to read this: the help of the command line shows it.
"""

from enum import StrEnum


class Word(StrEnum):
    """What a person says beside moving."""

    START = "start"
    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"
    REDO = "redo"
    QUIT = "quit"
    GRIPPER = "gripper"
    """Open the gripper if it is closed, else close it."""
    SLOWER = "slower"
    FASTER = "faster"
    TAKE_OVER = "take over"
    """Act in the place of a learner that is in control."""
    HAND_BACK = "hand back"
    """Let the learner act again."""


AXES: tuple[str, ...] = ("x", "y", "z", "rx", "ry", "rz")
"""Directions of a device, right-handed, as its person sees them: x away, y to the left, z up, and turns about these."""

UP, DOWN, RIGHT, LEFT = "\x1b[A", "\x1b[B", "\x1b[C", "\x1b[D"
"""What a terminal sends for the arrow keys."""

MOVES: dict[str, tuple[str, int]] = {
    "w": ("x", 1), "s": ("x", -1), UP: ("x", 1), DOWN: ("x", -1),
    "a": ("y", 1), "d": ("y", -1), LEFT: ("y", 1), RIGHT: ("y", -1),
    "r": ("z", 1), "f": ("z", -1),
    "l": ("rx", 1), "j": ("rx", -1),
    "i": ("ry", 1), "k": ("ry", -1),
    "u": ("rz", 1), "o": ("rz", -1),
}  # fmt: skip
"""Key to an axis and the direction along it."""

WORDS: dict[str, Word] = {
    " ": Word.GRIPPER,
    "\n": Word.START,
    "\r": Word.START,
    "y": Word.SUCCESS,
    "n": Word.FAILURE,
    "x": Word.DISCARD,
    "z": Word.REDO,
    "q": Word.QUIT,
    "-": Word.SLOWER,
    "=": Word.FASTER,
    "+": Word.FASTER,
    "t": Word.TAKE_OVER,
    "b": Word.HAND_BACK,
}
"""Key to a word."""

WAITING = "Enter starts, q quits"
ACTING = "y success  n failure  x discard  z redo  q quit"

HELP = """\
keys of --device keyboard (directions as you see the robot in the live view; `frame` in robot_configs/ changes that):
  w s or up down     away, towards you       i k      tip away, towards you
  a d or left right  left, right             j l      roll to the left, right
  r f                up, down                u o      turn to the left, right
  space              close or open the gripper        - =      slower, faster
words, which the keyboard says whatever the device:
  Enter start   y success   n failure (kept as such)   x discard   z redo from the same start   q quit
  beside a learner: t take over (so does moving the device)   b hand back
SpaceMouse: push and turn the cap; left button: gripper; right button: start, then success.
gamepad: left stick and triggers (right up, left down) move, right stick and left/right of the cross turn; A (cross):
  gripper; Start: start, then success; B (circle): failure; X, Y: discard; Select: redo; guide: quit; bumpers: speed.
"""
