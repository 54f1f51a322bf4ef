"""Steps that are not in a recording yet, kept where a killed process leaves them.

To pack steps costs least for many at a time; to lose none, each must leave the process at once. So the numbers of a
step are copied into a file that is mapped into memory, which costs no more than to copy them, and are packed when there
are `ROWS` of them. What is mapped belongs to the operating system: it survives the process, though not the machine.
"""

import json
import mmap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lfd.core.errors import OutputError

SUFFIX = ".steps"
"""What is appended to the name of the recording."""
ROWS = 64
HEADER_BYTES = 64 * 1024
HEAD = 3
"""Numbers of a row before those of the step: step + 1 (0 where there is none), and its two times [ns]."""


def journal_of(recording: Path) -> Path:
    """Where the steps of a recording are that are not in it."""
    return recording.with_name(recording.name + SUFFIX)


class Journal:
    """The steps that wait to be written.

    Raises `OutputError` when the file cannot be made, for example on a full disk.
    """

    def __init__(self, path: Path, width: int, about: Mapping[str, Any]):
        self._path, self.about, self.count = path, dict(about), 0
        header = json.dumps({"width": width, **about}).encode()
        assert len(header) < HEADER_BYTES
        size = HEADER_BYTES + 8 * ROWS * (HEAD + width)
        try:
            with path.open("wb+") as stream:
                stream.write(header.ljust(HEADER_BYTES) + bytes(size - HEADER_BYTES))  # room for all, or an error now
                stream.flush()
                self._map = mmap.mmap(stream.fileno(), size)
        except OSError as error:
            path.unlink(missing_ok=True)
            raise OutputError(f"cannot write {path}: {error.strerror}; choose another --out") from error
        self._numbers = np.frombuffer(self._map, np.float64, offset=HEADER_BYTES).reshape(ROWS, HEAD + width)
        self._head = np.frombuffer(self._map, np.int64, offset=HEADER_BYTES).reshape(ROWS, HEAD + width)[:, :HEAD]

    @property
    def is_full(self) -> bool:
        return self.count == ROWS

    def add(self, step: int, times_ns: tuple[int, int], numbers: Sequence[Any]) -> None:
        """Keep a step."""
        row = self.count
        np.concatenate(numbers, out=self._numbers[row, HEAD:])
        self._head[row, 1:] = times_ns
        self._head[row, 0] = step + 1  # last: it makes the row count
        self.count = row + 1

    def take(self) -> tuple[Float[np.ndarray, "N F"], Int[np.ndarray, "N 2"]]:
        """Numbers and times of the steps that wait; good until `clear`."""
        return self._numbers[: self.count, HEAD:], self._head[: self.count, 1:]

    def clear(self) -> None:
        """The steps are in the recording."""
        self._head[: self.count, 0] = 0
        self.count = 0

    def remove(self) -> None:
        """Delete the file; its memory goes with the last view of it, which may be that of an error."""
        del self._numbers, self._head, self._map
        self._path.unlink(missing_ok=True)


@dataclass(frozen=True)
class LeftSteps:
    """What a killed recording left in its journal."""

    about: Mapping[str, Any]
    """What the steps consist of."""
    rows: Sequence[tuple[int, int, int, Float[np.ndarray, "F"]]]
    """Step, its two times [ns], and its numbers."""


def read_journal(path: Path) -> LeftSteps | None:
    """The steps in a journal; None where there is none, or one that was hardly begun."""
    if not path.is_file():
        return None
    content = path.read_bytes()
    try:
        about = json.loads(content[:HEADER_BYTES])
        width = HEAD + about.pop("width")
        numbers = np.frombuffer(content, np.float64, ROWS * width, HEADER_BYTES).reshape(ROWS, width)
        head = np.frombuffer(content, np.int64, ROWS * width, HEADER_BYTES).reshape(ROWS, width)[:, :HEAD]
    except (ValueError, KeyError, TypeError):
        return None
    rows = [(int(s) - 1, int(a), int(b), n) for (s, a, b), n in zip(head, numbers[:, HEAD:], strict=True) if s > 0]
    return LeftSteps(about, rows)
