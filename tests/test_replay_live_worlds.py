"""Many worlds, watched: what is drawn, what is counted, and that nothing else changes."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import mujoco
import numpy as np
import pytest

from lfd.core.protocols import Observer
from lfd.experts.lift import LiftExpert
from lfd.replay.live_worlds import LiveWorlds, live_curves, live_worlds
from lfd.replay.viewer_process import HOST, program
from lfd.run.wilson import wilson_interval
from lfd.worlds.rollout import episode_rng, rollout
from tests.conftest import LIFT
from tests.test_replay import columns
from tests.test_replay_live_view import Seen


class Remembered:
    """A board that remembers what it was told."""

    def __init__(self) -> None:
        self.scenes: dict[int, Seen] = {}
        self.told: list[dict[str, float]] = []
        self.closed = False

    def scene(self, place: int) -> Seen:
        return self.scenes.setdefault(place, Seen())

    def tell(self, values: Mapping[str, float]) -> None:
        self.told.append(dict(values))

    def close(self) -> None:
        self.closed = True


class States:
    """What the world went through."""

    def begin(self, world, observation) -> None:
        self.rows = [world.sim_state()]

    def step(self, world, transition) -> None:
        self.rows.append(world.sim_state())

    def end(self, success: bool) -> None: ...

    def abort(self) -> None: ...


def run(world, observers: list[Observer], steps: int = 10) -> bool:
    return rollout(
        world, LiftExpert(world.spec), observers, episode_rng("eval", 3, 0), horizon=steps, hold_steps=steps
    ).success


def test_what_is_shown_is_the_world_and_the_world_does_not_notice(lift_world) -> None:
    alone = States()
    run(lift_world, [alone])
    board, seen = Remembered(), States()
    live = LiveWorlds(board)
    watching = live.begin()
    for index in range(3):
        run(lift_world, [seen, *watching(index)])
        np.testing.assert_array_equal(seen.rows, alone.rows)
    time.sleep(1.0)
    live.close()
    assert board.closed
    (scene,) = board.scenes.values()
    assert len(scene.models) == 1
    data, model = mujoco.MjData(scene.models[0]), scene.models[0]
    last = scene.places[-1]
    for drawn in (scene.places[0], last):
        distances = []
        for state in alone.rows:
            mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_kinematics(model, data)
            distances.append(np.abs(data.xpos - drawn).max())
        assert min(distances) < 1e-9
    assert distances[-1] == min(distances)
    assert board.told[-1] == dict(
        zip(("success", "interval_low", "interval_high"), (0.0, *wilson_interval(0, 3)), strict=True)
    )


def test_each_run_is_counted_from_its_beginning(lift_world) -> None:
    board = Remembered()
    live = LiveWorlds(board)
    for episodes in (3, 1):
        watching = live.begin()
        for index in range(episodes):
            run(lift_world, list(watching(index)), steps=1)
        time.sleep(0.5)
    live.close()
    assert [board.told[0], board.told[-1]] == [
        dict(zip(("success", "interval_low", "interval_high"), (0.0, *wilson_interval(0, count)), strict=True))
        for count in (3, 1)
    ]


def test_an_error_while_drawing_is_not_lost(lift_world) -> None:
    class Broken(Remembered):
        def scene(self, place: int) -> Seen:
            raise RuntimeError("no more paint")

    live = LiveWorlds(Broken())
    run(lift_world, list(live.begin()(0)))
    deadline = time.monotonic() + 20
    while live._drawing.is_alive() and time.monotonic() < deadline:
        time.sleep(0.05)
    with pytest.raises(RuntimeError, match="no more paint"):
        live.close()
    assert threading.active_count() < 20


def received(address: str, file: Path) -> subprocess.Popen[bytes]:
    """A program that saves what a browser at the address would get."""
    source = parse_qs(urlparse(address).query)["url"][0]
    command = [program(), "--connect", source, "--save", file, "--bind", HOST, "--port", "auto"]
    return subprocess.Popen(
        command,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def ended(reader: subprocess.Popen[bytes]) -> None:
    os.killpg(reader.pid, signal.SIGINT)
    reader.wait(20)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # its writer is interrupted
def test_worlds_and_curves_arrive_where_a_browser_looks(lift_world, tmp_path) -> None:
    told: list[str] = []
    with live_worlds("evaluation", 1, told.append) as live:
        reader = received(told[0], tmp_path / "worlds.rrd")
        watching = live.begin()
        for index in range(4):
            run(lift_world, list(watching(index)))
            time.sleep(1.0)
        ended(reader)
    held = columns(tmp_path / "worlds.rrd")
    assert sum(batch.num_rows for batch in held["/world_0/world/robot0_link7"]) > 2
    assert "/plots/success" in held
    with live_curves(told.append) as report:
        reader = received(told[1], tmp_path / "curves.rrd")
        for step in (10, 20):
            report({"step": step, "loss": 1.0 / step, "learning_rate": 1e-3})
            time.sleep(1.0)
        ended(reader)
    held = columns(tmp_path / "curves.rrd")
    steps = [
        row
        for batch in held["/plots/loss"]
        if "gradient_step" in batch.schema.names
        for row in batch["gradient_step"].to_pylist()
    ]
    assert sorted(steps) == [10, 20]


def test_what_cannot_be_watched(lfd_fails, tmp_path) -> None:
    out = tmp_path / "out"
    for command in (("record", LIFT), ("dagger", "policies/dagger_lift.toml")):
        said = lfd_fails(*command, "--live", "--device", "keyboard", "--out", out)
        assert "leave out --live" in said
    assert "leave out one of them" in lfd_fails("record", LIFT, "--live", "--cluster", "--out", out)
