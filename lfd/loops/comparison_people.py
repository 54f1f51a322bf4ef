"""Who answers "A or B?": a person at a terminal, a file, a simulated person."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.special import expit

from lfd.core.errors import InputError
from lfd.loops.comparing import Question, Reply
from lfd.loops.comparison_pool import Pool

REPLIES: dict[str, Reply] = {"a": "a", "b": "b", "e": "equal", "equal": "equal", "u": "undo", "q": "quit"}
HELP = "a or b: the one you like better; e: about equal; u: undo the last answer; q: stop, --resume goes on later"


class Simulated:
    """A person with the weights of the pool's recipe, who errs as the model of comparisons says.

    What they say to question n depends on the seed and n alone, not on what was asked before.
    """

    def __init__(self, pool: Pool, *, rationality: float, seed: int):
        recipe = pool.recipe
        self._returns = pool.counted(recipe.features) @ np.append(recipe.weights, recipe.smoothness)
        self._rationality, self._seed = rationality, seed

    def __call__(self, question: Question) -> Reply:
        rng = np.random.default_rng([6, self._seed, question.number])
        better = self._returns[question.a] - self._returns[question.b]
        return "a" if rng.random() < expit(self._rationality * better) else "b"


class FromFile:
    """One reply a line: a, b, e, u or q; empty lines and what follows a # do not count. Its end stops the questions."""

    def __init__(self, path: Path, *, taken: int):
        """`taken` replies were used before. Raises `InputError` for a file that is not there or a line that is none."""
        if not path.is_file():
            raise InputError(
                f"no file {path}; --person takes me, simulated, or a file with one of a, b, e, u, q a line"
            )
        lines = [line.partition("#")[0].strip().lower() for line in path.read_text(encoding="utf-8").splitlines()]
        for number, line in enumerate(lines, 1):
            if line and line not in REPLIES:
                raise InputError(f"{path}, line {number}: {line!r} is no answer; write one of {', '.join(REPLIES)}")
        self._replies: list[Reply] = []
        self._replies.extend(REPLIES[line] for line in [line for line in lines if line][taken:])

    def __call__(self, _question: Question) -> Reply:
        return self._replies.pop(0) if self._replies else "quit"


class AtTerminal:
    """A person who reads the question on standard error and types the reply."""

    def __init__(self, show: Callable[[Question], str], *, replies: Iterator[str] | None = None):
        """`show` shows a question and says where; `replies` are lines in the place of standard input."""
        self._show, self._replies = show, sys.stdin if replies is None else replies
        print(HELP, file=sys.stderr)

    def __call__(self, question: Question) -> Reply:
        where = self._show(question)
        print(f"question {question.number + 1}: {where}", file=sys.stderr)
        while True:
            print("a / b / e / u / q > ", end="", file=sys.stderr, flush=True)
            line = next(iter(self._replies), None)
            if line is None:
                return "quit"
            reply = REPLIES.get(line.strip().lower())
            if reply is not None:
                return reply
            print(HELP, file=sys.stderr)
