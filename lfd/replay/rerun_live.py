"""A scene that moves in Rerun's web viewer, served on this machine's loopback only.

Rerun's SDK would serve on every interface, so its program serves and the SDK connects to it. (A blueprint that is
given while connecting never arrives: it is sent afterwards.)
"""

import errno
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from urllib.parse import quote

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lfd.core.errors import LfdError
from lfd.core.rotations import xyzw_from_wxyz
from lfd.replay.rerun_scene import body_name, log_shapes, scene_view

HOST = "127.0.0.1"
WEB_PORT, DATA_PORT = 9090, 9876
"""Rerun's own ports, taken when they are free: a tunnel can then be opened beforehand."""
EYE = (1.4, -0.35, 1.45)
"""From where the person looks [m]: nearly opposite to the robot, so that away from them is towards it."""
START_S = 30.0
"""How long the server may take to answer [s]."""
KEEPER = '"$@" & read -r _; kill 0'
"""A shell that ends the server, and itself, when its input closes: however the process that started it ends."""


@contextmanager
def serving() -> Iterator[tuple[str, str]]:
    """A web viewer while the block runs: its address, and the one to send data to.

    Raises `LfdError` when Rerun's server does not start.
    """
    web, data = _free(WEB_PORT), _free(DATA_PORT)
    program = Path(sys.executable).parent / "rerun"
    command = [program, "--bind", HOST, "--serve-web", "--port", str(data), "--web-viewer-port", str(web)]
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
                raise LfdError(f"Rerun's viewer does not start; --no-view records without it. It says:\n{said.read()}")
            source = f"rerun+http://{HOST}:{data}/proxy"
            yield f"http://{HOST}:{web}?url={quote(source, safe='')}", source
        finally:
            keeper.stdin.close()
            keeper.wait()


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


class RerunScene:
    """Sends a model to a viewer and moves its bodies; time is that of the clock since the beginning."""

    def __init__(self, source: str):
        self._recording = rr.RecordingStream("lfd")
        self._recording.connect_grpc(source)
        self._recording.send_recording_name("live")
        panels = (
            rrb.TimePanel(state="collapsed"),
            rrb.SelectionPanel(state="hidden"),
            rrb.BlueprintPanel(state="hidden"),
        )
        self._recording.send_blueprint(rrb.Blueprint(scene_view(EYE), *panels))
        self._began = time.monotonic()

    def load(self, model: mujoco.MjModel) -> None:
        """Show another model, which takes the place of one with the same names."""
        log_shapes(self._recording, model)
        self._model, self._shown = model, np.full((model.nbody, 7), np.nan)

    def move(self, data: mujoco.MjData) -> None:
        """Show the bodies where they are in `data`; those that stayed need no message."""
        places = np.hstack([data.xpos, data.xquat])
        self._recording.set_time("time", duration=time.monotonic() - self._began)
        for body in np.flatnonzero((places != self._shown).any(axis=1)):
            pose = rr.Transform3D(
                translation=places[body, :3], quaternion=rr.Quaternion(xyzw=xyzw_from_wxyz(places[body, 3:]))
            )
            self._recording.log(f"world/{body_name(self._model, int(body))}", pose)
        self._shown = places

    def close(self) -> None:
        """Send what is still waiting."""
        self._recording.flush()
        self._recording.disconnect()
