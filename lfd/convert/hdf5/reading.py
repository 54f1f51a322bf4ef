"""Asks the process that opens HDF5 files (`lfd.convert.hdf5.worker`), and starts another one when a file ends it."""

import atexit
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lfd.core.errors import RecordingError

PROGRAM = Path(__file__).with_name("worker.py")
SIGNATURE = b"\x89HDF\r\n\x1a\n"
ADVICE = "the file is damaged: take it from its source again, or leave it out"


@dataclass(frozen=True)
class Answer:
    """What a file holds."""

    content: Mapping[str, Any]
    """Texts, numbers and names."""
    arrays: Mapping[str, np.ndarray]
    """Datasets by their path within the demonstration, as they are stored."""
    growth: int
    """Bytes by which the memory of the reading process grew, at its peak."""


class _Process:
    """The running process."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._said = tempfile.TemporaryFile()  # noqa: SIM115, `end` closes it
        self._running = subprocess.Popen(
            [sys.executable, "-P", str(PROGRAM)],  # -P: modules beside the program are not the library's
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )

    def ask(self, request: Mapping[str, Any]) -> Answer | None:
        """The answer; None when the process ended over it."""
        assert self._running.stdin is not None
        assert self._running.stdout is not None
        try:
            self._running.stdin.write(json.dumps(request).encode() + b"\n")
            self._running.stdin.flush()
        except BrokenPipeError:
            return None
        line = self._running.stdout.readline()
        if not line.endswith(b"\n"):
            return None
        content = json.loads(line)
        arrays = {}
        for name, kind, shape in content.pop("arrays"):
            arrays[name] = np.empty(shape, kind)
            if arrays[name].size and not _filled(self._running.stdout, arrays[name]):
                return None
        return Answer(content, arrays, content.pop("growth"))

    def end(self) -> str:
        """End the process and say how it ended."""
        if self._running.stdin is not None:
            with suppress(BrokenPipeError):  # it ended before it read the request
                self._running.stdin.close()
        if self._running.stdout is not None:
            self._running.stdout.close()
        try:
            code = self._running.wait(1.0)
        except subprocess.TimeoutExpired:
            self._running.kill()
            code = self._running.wait()
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").split("\n")
        self._said.close()
        if code in (-signal.SIGPROF, -signal.SIGALRM):
            return "took too long"
        last = next((text.strip() for text in reversed(lines) if text.strip()), "")
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"ended the HDF5 library ({how}{', ' + last if last else ''})"


def _filled(stream: Any, array: np.ndarray) -> bool:
    """Fill an array from a stream; whether there was enough."""
    return stream.readinto(array.data.cast("B")) == array.nbytes


_lock = threading.Lock()
_kept: list[_Process] = []


def ask(path: Path, demo: str | None, obs: Sequence[str] | None) -> Answer:
    """What the file `path` holds as a whole, or in one demonstration with the observations `obs` (None: all).

    Raises `RecordingError` naming the file and the demonstration: not there, no HDF5, refused, or damaged so that
    reading it crashed, took too long, or wanted more memory than four times the file's size and a constant.
    """
    where = f"{path}" if demo is None else f"{path} {demo}"
    try:
        with path.open("rb") as stream:
            is_hdf5 = _is_hdf5(stream)
    except OSError as error:
        raise RecordingError(f"{path} cannot be opened: {error.strerror}") from error
    if not is_hdf5:
        raise RecordingError(f"{path} is no HDF5 file: it does not begin as one")
    with _lock:
        process = _process()
        is_whole = False
        try:
            request = {"path": str(path.absolute()), "demo": demo, "obs": None if obs is None else list(obs)}
            answer = process.ask(request)
            is_whole = answer is not None
        finally:  # also after Ctrl-C: half an answer may be on its way
            how = "" if is_whole else _end()
    if answer is None:
        raise RecordingError(f"{where}: reading it {how}; {ADVICE}")
    if "error" in answer.content:
        advice = f"; {ADVICE}" if answer.content.get("damaged") else ""
        raise RecordingError(f"{where}: {answer.content['error']}{advice}")
    return answer


def _is_hdf5(stream: BinaryIO) -> bool:
    """Whether the signature stands where the format allows it: at 0, 512, 1024, 2048 and so on."""
    at = 0
    while stream.seek(at) == at and (found := stream.read(len(SIGNATURE))):
        if found == SIGNATURE:
            return True
        at = max(512, 2 * at)
    return False


def _process() -> _Process:
    if _kept and _kept[0].owner != os.getpid():
        _kept.clear()  # a fork has its own
    if not _kept:
        _kept.append(_Process())
    return _kept[0]


def _end() -> str:
    return _kept.pop().end() if _kept and _kept[0].owner == os.getpid() else ""


atexit.register(_end)
