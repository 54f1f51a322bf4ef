"""Rerun's viewer as a program of its own: served as a web page on this machine's loopback only, or as a window.

Rerun's SDK would serve on every interface, so its program serves and the SDK connects to it. (A blueprint that is
given while connecting never arrives: it is sent afterwards.) The page and all that it needs come from the program: no
internet is used.
"""

import errno
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from urllib.parse import quote

from lfd.core.errors import LfdError, OutputError

HOST = "127.0.0.1"
WEB_PORT, DATA_PORT = 9090, 9876
"""Rerun's own ports, taken when they are free: a tunnel can then be opened beforehand."""
START_S = 30.0
"""How long the viewer may take to answer [s]."""
KEEPER = '"$@" & read -r _; kill 0'
"""A shell that ends the server, and itself, when its input closes: however the process that started it ends."""


@contextmanager
def serving() -> Iterator[tuple[str, str]]:
    """A web viewer while the block runs: its address, and the one to send data to.

    Raises `LfdError` when Rerun's server does not start.
    """
    web, data = _free(WEB_PORT), _free(DATA_PORT)
    command = [program(), "--bind", HOST, "--serve-web", "--port", str(data), "--web-viewer-port", str(web)]
    with TemporaryFile("w+", encoding="utf-8", errors="replace") as said:
        keeper = subprocess.Popen(
            ["sh", "-c", KEEPER, "sh", *command, "--hide-welcome-screen"],
            stdin=subprocess.PIPE,
            stdout=said,
            stderr=said,
            start_new_session=True,  # Ctrl-C is for us
        )
        assert keeper.stdin is not None
        try:
            if not (_answers(web) and _answers(data)):
                said.seek(0)
                raise LfdError(
                    "Rerun's viewer does not start; go on without it: leave out --live, add --no-view, or write a file "
                    f"with --save. It says:\n{said.read()}"
                )
            yield f"http://{HOST}:{web}?url={quote(_source(data), safe='')}", _source(data)
        finally:
            keeper.stdin.close()
            keeper.wait()


def check_screen() -> None:
    """Raise `OutputError` when there is no screen to open a window on."""
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        raise OutputError(
            "no screen to open the viewer on; write a file with --save X.rrd and open it elsewhere, or look with a "
            "browser with --serve"
        )


def open_window() -> str:
    """Open Rerun's own window, which stays when this process ends; returns the address to send data to.

    Raises `OutputError` when there is no screen, `LfdError` when the window does not open.
    """
    check_screen()
    port = _free(DATA_PORT)
    command = [program(), "--bind", HOST, "--port", str(port), "--hide-welcome-screen", "--expect-data-soon"]
    subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    if not _answers(port):
        raise LfdError("Rerun's viewer does not open its window; look with a browser with --serve")
    return _source(port)


def program() -> str:
    """Rerun's program."""
    return str(Path(sys.executable).parent / "rerun")


def _source(port: int) -> str:
    return f"rerun+http://{HOST}:{port}/proxy"


def _free(wanted: int) -> int:
    """The port `wanted`, or another one if it is taken, also by connections that have just ended."""
    with socket.socket() as probe:
        try:
            probe.bind((HOST, wanted))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            probe.bind((HOST, 0))
        return probe.getsockname()[1]


def _answers(port: int) -> bool:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return True
        time.sleep(0.05)
    return False
