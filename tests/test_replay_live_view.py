"""The view of a world in motion: Rerun's real server, read over HTTP and gRPC."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import mujoco
import numpy as np
import pytest

from lfd.core.protocols import Decision, StepResult, Transition
from lfd.experts.lift import LiftExpert
from lfd.replay.live_view import LiveView, has_screen, live_view
from lfd.replay.rerun_live import serving
from lfd.worlds.rollout import rollout


class Seen:
    """A scene that remembers what it was given."""

    def __init__(self) -> None:
        self.models: list[mujoco.MjModel] = []
        self.places: list[np.ndarray] = []

    def load(self, model: mujoco.MjModel) -> None:
        self.models.append(model)

    def move(self, data: mujoco.MjData) -> None:
        self.places.append(data.xpos.copy())

    def close(self) -> None: ...


def test_the_view_shows_the_worlds_bodies_and_leaves_the_world_alone(lift_world) -> None:
    lift_world.reset(np.random.default_rng(4))
    state = lift_world.get_state()
    ended = []
    for view in (None, LiveView(scene := Seen(), "")):
        observers = [] if view is None else [view]
        rollout(
            lift_world, LiftExpert(lift_world.spec), observers, np.random.default_rng(4),
            horizon=20, hold_steps=20, start=state,
        )  # fmt: skip
        ended.append(lift_world.sim_state())
    np.testing.assert_array_equal(*ended)
    assert len(scene.models) == 1
    cube = scene.models[0].body("cube_main").id
    np.testing.assert_allclose(scene.places[0][cube], state.sim[1 : 1 + len(scene.models[0].qpos0)][-7:-4], atol=1e-9)


def test_a_picture_is_drawn_at_most_25_times_a_second(lift_world) -> None:
    lift_world.reset(np.random.default_rng(4))
    scene = Seen()
    view = LiveView(scene, "")
    view.show(lift_world)
    began = time.monotonic()
    observation = lift_world.reset(np.random.default_rng(4))
    still = Decision(np.zeros(7))
    while time.monotonic() - began < 0.5:
        view.step(lift_world, Transition(0, observation, still, StepResult(observation, 0.0, False), False))
    assert 2 <= len(scene.places) <= 14


WINDOW = """
import sys
import numpy as np
from lfd import make_world
from lfd.replay.live_view import WindowScene, live_view

world = make_world("Lift", "panda", 20)
with live_view() as view:
    assert isinstance(view._scene, WindowScene) and view.address == ""
    for seed in (1, 2):  # cubes of different sizes
        world.reset(np.random.default_rng(seed))
        view.show(world)
        for _ in range(5):
            world.step(np.zeros(7))
            view._draw(world)
        size = world._model.geom("cube_g0").size
        np.testing.assert_array_equal(view._scene._model.geom("cube_g0").size, size)
        np.testing.assert_array_equal(view._scene._data.qpos, world._data.qpos)
    assert view._scene._window.is_running()
print("closed")
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no Xvfb; `apt install xvfb` brings one")
def test_with_a_screen_mujocos_window_follows_the_world() -> None:
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24"]
    with subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL) as screen:
        os.close(write)
        with os.fdopen(read) as told:
            environment = os.environ | {"DISPLAY": f":{told.readline().strip()}"}
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", WINDOW], env=environment, capture_output=True, text=True, check=False
        )
        screen.terminate()
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("closed\n")


@pytest.fixture
def no_screen(monkeypatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if has_screen():
        pytest.skip("this platform always has a screen")


def test_without_a_screen_a_browser_sees_it_on_loopback_only(lift_world, no_screen, record_property) -> None:
    with live_view() as view:
        page = urllib.request.urlopen(view.address.partition("?")[0], timeout=10).read()
        assert b"Rerun" in page
        address = urlparse(view.address)
        assert address.hostname == "127.0.0.1"
        data_port = urlparse(parse_qs(address.query)["url"][0].removeprefix("rerun+")).port
        outside = _outside()
        for port in (address.port, data_port):
            assert port is not None
            with socket.socket() as probe:
                assert probe.connect_ex(("127.0.0.1", port)) == 0
            if outside:
                with socket.socket() as probe:
                    assert probe.connect_ex((outside, port)) != 0
        lift_world.reset(np.random.default_rng(5))
        began = time.perf_counter()
        view.show(lift_world)
        shown = time.perf_counter() - began
        costs = []
        for _ in range(40):
            lift_world.step(np.array([0.5, 0.1, -0.2, 0, 0, 0.2, 1.0]))
            began = time.perf_counter()
            view._draw(lift_world)
            costs.append(time.perf_counter() - began)
            time.sleep(0.02)
    record_property("show_ms", 1e3 * shown)
    record_property("median_step_ms", 1e3 * float(np.median(costs)))
    record_property("max_step_ms", 1e3 * max(costs))
    print(f"show {shown:.2f} s, step {1e3 * np.median(costs):.2f} ms, at most {1e3 * max(costs):.1f} ms")
    assert np.median(costs) < 0.02
    assert ends(address.port or 0)


def ends(port: int) -> bool:
    """Whether nobody serves on a port any more, within ten seconds."""
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) != 0:
                return True
        time.sleep(0.1)
    return False


def _outside() -> str:
    """This machine's address on its network, where it has one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        if probe.connect_ex(("192.0.2.1", 9)) != 0:  # sends nothing
            return ""
        return probe.getsockname()[0]


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # its writer is interrupted
def test_what_is_sent_arrives(lift_world, no_screen, tmp_path) -> None:
    """Another program reads the stream that a browser would."""
    file = tmp_path / "live.rrd"
    with live_view() as view:
        source = parse_qs(urlparse(view.address).query)["url"][0]
        lift_world.reset(np.random.default_rng(5))
        view.show(lift_world)
        command = [Path(sys.executable).parent / "rerun", "--connect", source, "--save", file]
        reader = subprocess.Popen(
            [*command, "--bind", "127.0.0.1", "--port", "auto"],
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it in background jobs
        )
        for _ in range(60):
            lift_world.step(np.array([0.5, 0.1, -0.2, 0, 0, 0.2, 1.0]))
            view._draw(lift_world)
            time.sleep(0.05)
        os.killpg(reader.pid, signal.SIGINT)  # the program that `rerun` starts is the one that saves
        reader.wait(20)
    from tests.test_replay import columns

    held = columns(file)
    assert "/world/cube_main" in held
    assert sum(batch.num_rows for batch in held["/world/robot0_link7"]) > 20


def test_the_server_ends_also_when_the_process_is_killed(no_screen) -> None:
    code = (
        "import time\nfrom lfd.replay.rerun_live import serving\n"
        "with serving() as (address, _):\n    print(address, flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = urlparse(process.stdout.readline()).port
        assert port is not None
        os.kill(process.pid, signal.SIGKILL)
    assert ends(port)


def test_two_views_take_different_ports(no_screen) -> None:
    with serving() as (one, _), serving() as (other, _):
        assert urlparse(one).port != urlparse(other).port
