"""`lfd bench replay`: how much faster than real time episodes become Rerun files, how large these are, what being
watched costs.

Times are of the processor, so that they hold on a machine that is busy. What it costs to be watched is measured on the
same worlds with and without, in turn, with somebody who receives all that is sent; the server's time counts too.
"""

import os
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lfd.core.protocols import Observer, Observers, Progress, silent, unwatched
from lfd.experts.playback import PlaybackPolicy
from lfd.interaction.driving_robots import DriverOptions
from lfd.loops.correcting import (
    CorrectionRecipe,
    correct,
    learner_of,
    make_correction_world,
    scripted,
    set_up,
    start_reward,
)
from lfd.loops.interacting import InteractRecipe, run_trial
from lfd.loops.replaying import scene_shapes
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.pacing import Paced
from lfd.replay import shown_mesh
from lfd.replay.clip import Clip, kept_model, recording_clip
from lfd.replay.live_worlds import RATE, LiveWorlds
from lfd.replay.rerun_live import RerunBoard, serving
from lfd.replay.rerun_scene import replay
from lfd.replay.viewer_process import HOST, program
from lfd.worlds.robosuite_world import RobosuiteWorld, make_world
from lfd.worlds.rollout import episode_rng, rollout

CONTROL_HZ, SECONDS = 20, 10.0
CAMERAS, SIDE = ("agentview", "robot0_eye_in_hand"), 128
SERVER = "--serve-web"
"""By which the server is found among the processes."""


@dataclass(frozen=True, kw_only=True)
class ReplayBench:
    """What one run measured."""

    task: str
    robot: str
    real_time: dict[str, float]
    """Kind of episode to its length over the processor time from its recording to its Rerun file."""
    once: dict[str, float]
    """What is done once for a model in a process, processor time [s]."""
    megabytes: dict[str, float]
    """Kind of episode to the size of its Rerun file [MB]."""
    live: dict[str, float]
    """What it costs to be watched."""


def bench_replay(
    *, task: str, robot: str, repeats: int, pairs: int, every_kind: bool, seed: int, progress: Progress = silent
) -> ReplayBench:
    """Measure files over `repeats`, being watched over `pairs` of runs; corrections and cameras with `every_kind`.

    Raises `UnknownName` for a task or robot that lfd does not know.
    """
    with progress("bench replay", 3) as bar, TemporaryDirectory() as name:
        folder = Path(name)
        world = make_world(task, robot, CONTROL_HZ)
        made = _recordings(world, folder, every_kind=every_kind, seed=seed)
        bar.advance(note="recorded")
        first = f"{task}, {SECONDS:g} s at {CONTROL_HZ} Hz"
        once = _once(made[first])
        real_time, megabytes = {}, {}
        for kind, path in made.items():
            speed, megabytes[kind] = _measured(path, folder / "out.rrd", repeats)
            real_time[kind] = round(speed, 1)
        clip = recording_clip(made[first])
        megabytes["of these, meshes and layout"] = _size(_still(clip), folder / "out.rrd")
        bar.advance(note=f"{real_time[first]:.0f}x real time")
        live = _live(world, folder, pairs, seed)
        bar.advance()
    return ReplayBench(task=task, robot=robot, real_time=real_time, once=once, megabytes=megabytes, live=live)


def _recordings(world: RobosuiteWorld, folder: Path, *, every_kind: bool, seed: int) -> dict[str, Path]:
    """A recording of each kind."""
    spec = world.spec
    made = {f"{spec.task}, {SECONDS:g} s at {CONTROL_HZ} Hz": folder / "plain.mcap"}
    _record(world, folder / "plain.mcap", seed)
    recipe = InteractRecipe(
        scene="merge",
        robots=(DriverOptions(kind="active", assumed="aggressive"),),
        person="random",
        episodes=1,
        seed=seed,
    )
    origin = Origin(stage="eval", policy="active", seed=seed, index=0, recipe={})
    run_trial(recipe, recipe.robots[0], 0, [McapRecorder(folder / "merge.mcap", origin, keep_failures=True)])
    made["an interaction, merge at 5 Hz"] = folder / "merge.mcap"
    if not every_kind:
        return made
    filmed = make_world(spec.task, spec.robot, CONTROL_HZ)
    filmed.take_cameras(CAMERAS, height=SIDE, width=SIDE)
    _record(filmed, folder / "filmed.mcap", seed)
    made[f"the same with {len(CAMERAS)} cameras of {SIDE} x {SIDE}"] = folder / "filmed.mcap"
    pushed = CorrectionRecipe(task="laptop", robot=spec.robot, runs=1, seed=seed)
    setup = set_up(pushed)
    learner, person = learner_of(start_reward(pushed), pushed), scripted(pushed, setup)
    correct(pushed, setup, learner, person, make_correction_world(pushed), out=folder / "corrected")
    made[f"a correction, {pushed.duration_s:g} s at {pushed.control_hz} Hz"] = next(
        (folder / "corrected").glob("*.mcap")
    )
    return made


def _record(
    world: RobosuiteWorld, path: Path, seed: int, watching: Sequence[Observer] = (), *, paced: bool = False
) -> None:
    """An episode of small random actions, as fast as it goes or in real time."""
    steps, size = round(SECONDS * CONTROL_HZ), len(world.spec.action_low)
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (steps, size))
    origin = Origin(stage="record", policy="bench", seed=seed, index=0, recipe={})
    observers = [McapRecorder(path, origin, keep_failures=True), *watching]
    start = episode_rng("record", seed, 0)
    policy = PlaybackPolicy(actions)
    rollout(
        world, Paced(policy, CONTROL_HZ) if paced else policy, observers, start, horizon=steps, hold_steps=steps + 1
    )


def _once(path: Path) -> dict[str, float]:
    """Compile the model and prepare its meshes, as the first replay of a process does."""
    kept_model.cache_clear()
    shown_mesh.forget()
    began = time.process_time()
    clip = recording_clip(path)
    compiled = time.process_time()
    replay(clip, save=path.with_suffix(".first.rrd"))
    whole = time.process_time() - compiled
    began_again = time.process_time()
    replay(clip, save=path.with_suffix(".again.rrd"))
    return {
        "compiling the model": round(compiled - began, 2),
        "preparing meshes": round(whole - (time.process_time() - began_again), 2),
    }


def _measured(path: Path, out: Path, repeats: int) -> tuple[float, float]:
    """Times faster than real time, the median over repeats; and the size [MB]."""
    speeds = []
    for _ in range(repeats + 1):
        began = time.process_time()
        clip = recording_clip(path, scene_shapes)
        replay(clip, save=out, overwrite=True)
        speeds.append(float(clip.times[-1]) / (time.process_time() - began))
    return float(np.median(speeds[1:])), round(out.stat().st_size / 1e6, 2)


def _still(clip: Clip) -> Clip:
    """The first moment of a clip, without curves."""
    assert clip.qpos is not None
    return replace(
        clip, times=clip.times[:1], qpos=clip.qpos[:1], curves={}, positions={}, pictures={}, arrows={}, plans={}
    )


def _size(clip: Clip, out: Path) -> float:
    replay(clip, save=out, overwrite=True)
    return round(out.stat().st_size / 1e6, 2)


def _live(world: RobosuiteWorld, folder: Path, pairs: int, seed: int) -> dict[str, float]:
    """What it costs to be watched, in turn with and without.

    Drawing takes the same time of a core however fast the world is, so it is measured on a world that runs in real
    time and has little else to do; at full speed the rest shows, keeping states, in what else is noise.
    """
    with serving() as (_, source), _reader(source, folder / "read.rrd"):
        board = LiveWorlds(RerunBoard(source, "bench", [RATE], scenes=1))

        def run(observers: Observers, *, paced: bool, times: int = 1) -> tuple[float, float]:
            began, wall = _spent(), time.perf_counter()
            for _ in range(times):
                _record(world, folder / "live.mcap", seed, observers(0), paced=paced)
            return _spent() - began, time.perf_counter() - wall

        first, _ = run(board.observers, paced=False)  # loads the model and sends its shapes
        second, _ = run(unwatched, paced=False)
        of_a_core, ratios = [], []
        for _ in range(pairs):
            (seen, wall), (alone, _) = (run(watching, paced=True) for watching in (board.observers, unwatched))
            of_a_core.append((seen - alone) / wall)
            (seen, _), (alone, _) = (run(w, paced=False, times=5) for w in (board.observers, unwatched))
            ratios.append(seen / alone)
        board.close()
    return {
        "share of a core for a world that is watched": round(float(np.median(of_a_core)), 4),
        "processor time of recording at full speed, watched to not": round(float(np.median(ratios)), 3),
        "to begin [s]": round(max(0.0, first - second), 2),
    }


@contextmanager
def _reader(source: str, path: Path) -> Iterator[None]:
    """Somebody who receives all that is sent to a viewer, as a browser does."""
    command = [program(), "--connect", source, "--save", str(path), "--bind", HOST, "--port", "auto"]
    reader = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        yield
    finally:
        os.killpg(reader.pid, signal.SIGTERM)  # the command is a wrapper around the program
        reader.wait()


def _spent() -> float:
    """Processor time of this process, and on Linux of the viewer's server that it has started [s]."""
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if SERVER.encode() in stat.with_name("cmdline").read_bytes().split(b"\0"):
                ticks += sum(map(int, stat.read_text().rpartition(")")[2].split()[11:13]))
        except FileNotFoundError:  # it has just ended
            continue
    return time.process_time() + ticks / 100
