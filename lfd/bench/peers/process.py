"""Peers' programs as processes, in an environment of their own that is made when it is first needed.

Peers want other versions of what lfd stands on, so they are never installed beside it.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from importlib.metadata import version
from pathlib import Path

from lfd.core.errors import LfdError
from lfd.core.processes import THREADS

WANTED = ("robomimic==0.3.0", "imitation==1.0.1", "numpy==1.26.4", "six")
"""With the torch that lfd has; robomimic imports six and does not say so."""
LEFT_OUT = "egl-probe; sys_platform == 'never'"
"""robomimic's search for a GPU to draw with, which has to be compiled and is not used here."""
MARK = "installed.txt"


class PeerError(LfdError):
    """A peer that cannot be installed or run on this machine."""


def peer_python(folder: Path, say: Callable[[str], None]) -> Path:
    """The Python of the peers' environment in `folder`, which is made when it is not there or of other versions.

    Raises `PeerError` when it cannot be made, for example without a network.
    """
    wanted = (*WANTED, f"torch=={version('torch').partition('+')[0]}")
    python, mark = folder / "bin" / "python", folder / MARK
    if mark.is_file() and mark.read_text(encoding="utf-8").splitlines() == list(wanted):
        return python
    say("installing robomimic and imitation in an environment of their own")
    uv = shutil.which("uv") or shutil.which("uv", path=str(Path(sys.executable).parent))
    if uv is None:
        raise PeerError("uv was not found, which installs the peers; `pip install uv` brings it")
    shutil.rmtree(folder, ignore_errors=True)
    _run([uv, "venv", "--quiet", "--python", sys.executable, str(folder)])
    overrides = folder / "overrides.txt"
    overrides.write_text(f"{LEFT_OUT}\n", encoding="utf-8")
    _run([uv, "pip", "install", "--quiet", "--python", str(python), "--overrides", str(overrides), *wanted])
    mark.write_text("\n".join(wanted), encoding="utf-8")
    return python


def peers_folder() -> Path:
    """Where the environment is kept from one benchmark to the next."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lfd" / "bench-peers"


class Peer(AbstractContextManager["Peer"]):
    """A peer's program, ready to take gradient steps on the rows of an .npz file, in one thread.

    Raises `PeerError` when it ends before it should, with the last line that it wrote.
    """

    def __init__(self, python: Path, program: Path, rows: Path, *, hidden_sizes: Sequence[int], batch_size: int):
        options = json.dumps({"hidden_sizes": list(hidden_sizes), "batch_size": batch_size})
        self._program = program.name
        self._log = rows.with_name(f"{program.name}.log").open("w+", encoding="utf-8")
        self._process = subprocess.Popen(
            [str(python), "-W", "ignore", str(program), str(rows), options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            env=os.environ | dict.fromkeys(THREADS, "1") | {"CUDA_VISIBLE_DEVICES": ""},
        )

    def __call__(self, steps: int) -> float:
        """Take gradient steps; returns their CPU time [s]."""
        assert self._process.stdin
        assert self._process.stdout
        try:
            self._process.stdin.write(f"{steps}\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it has ended; why is in its log
        for line in self._process.stdout:  # libraries print there too
            if line.startswith("seconds "):
                return float(line.split()[1])
        self._log.seek(0)
        said = self._log.read().strip().splitlines() or ["nothing"]
        raise PeerError(f"{self._program} ended: {said[-1]}")

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._log.close()


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["nothing"]
        raise PeerError(f"{Path(command[0]).name} {' '.join(command[1:3])} failed: {said[0]}")
