"""`lfd bench record`: what recording costs, how our writer compares with others, and whether it keeps up with a robot.

Ratios are of CPU time, the sides in turn on the same messages, so that they hold on a machine that is busy.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lfd.bench.library_writers import WRITERS, step_by_step
from lfd.core.protocols import Observer, Progress, silent
from lfd.experts.playback import PlaybackPolicy
from lfd.record import cdr
from lfd.record.columns import joint_state_pack
from lfd.record.episode_file import McapRecorder, Origin, read_episode
from lfd.record.episode_writing import write_episode
from lfd.record.layouts import BlockMessage, Layout, StepBlock
from lfd.record.mcap_file import read_mcap
from lfd.record.mcap_writing import McapWriter
from lfd.record.png import encode_png
from lfd.worlds.robosuite_world import RobosuiteWorld, make_world
from lfd.worlds.rollout import episode_rng, rollout

CAMERAS = ("agentview", "robot0_eye_in_hand")
JOINT_HZ, CAMERA_HZ, SIDE = 1000, 30, 256
"""The robot that must be kept up with: joint states and two cameras."""


@dataclass(frozen=True, kw_only=True)
class RecordBench:
    """What one run measured."""

    task: str
    robot: str
    cost: dict[str, float]
    """Length of episodes [s] to the simulation's CPU time with recording, as a multiple of that without."""
    writers: dict[str, dict[str, float]]
    """Writer to messages and MB a second of CPU time, for the messages of a recording."""
    ratios: dict[str, float]
    real_time: dict[str, float]
    """1000 Hz joint states and two cameras at 30 Hz: share of a core, lateness [s], size [MB/s]."""


def bench_record(
    *, task: str, robot: str, control_hz: int, episodes: int, seconds: float, seed: int, progress: Progress = silent
) -> RecordBench:
    """Measure over `episodes` pairs of episodes, and over `seconds` of real time.

    Raises `UnknownName` for a task or robot that lfd does not know.
    """
    world = make_world(task, robot, control_hz)
    with progress("bench record", 4) as bar, TemporaryDirectory() as folder:
        path = Path(folder) / "episode.mcap"
        cost = {}
        for length in (2.5, 10.0):
            cost[f"{length:g} s"] = round(_cost(world, path, round(length * control_hz), episodes, seed), 3)
            bar.advance(note=f"episodes of {length:g} s: {cost[f'{length:g} s']:.3f}x")
        writers = _compare_writers(path, episodes)
        bar.advance(note=f"{writers['ours']['messages_per_second']:.0f} messages/s")
        real_time = _keep_up(task, robot, path, seconds)
        bar.advance()
    ours = writers["ours"]["messages_per_second"]
    ratios = {f"ours_vs_{name}": round(ours / writers[name]["messages_per_second"], 2) for name in WRITERS}
    return RecordBench(task=task, robot=robot, cost=cost, writers=writers, ratios=ratios, real_time=real_time)


def _cost(world: RobosuiteWorld, path: Path, steps: int, episodes: int, seed: int) -> float:
    """Median over pairs of episodes of the CPU time with recording over that without, resets included."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-0.3, 0.3, (steps, len(world.spec.action_low)))
    origin = Origin(stage="record", policy="bench", seed=seed, index=0, recipe={})

    def run(observers: Sequence[Observer], index: int) -> float:
        began = time.process_time()
        start = episode_rng("record", seed, index)
        rollout(world, PlaybackPolicy(actions), observers, start, horizon=steps, hold_steps=steps + 1)
        return time.process_time() - began

    ratios = []
    for index in range(episodes + 1):
        without = run([], index)
        ratios.append(run([McapRecorder(path, origin, keep_failures=True)], index) / without)
    return float(np.median(ratios[1:]))  # the first one warms up


def _compare_writers(recording: Path, repeats: int) -> dict[str, dict[str, float]]:
    """Write the steps of a recording with each writer, in turn, all from the same arrays."""
    content, episode = read_mcap(recording), read_episode(recording)
    count = sum(len(rows) for rows in content.messages.values())
    size = sum(len(data) for rows in content.messages.values() for _, data in rows) / 1e6
    with TemporaryDirectory() as folder:
        path = Path(folder) / "out.mcap"
        sides: dict[str, Callable[[], None]] = {"ours": lambda: write_episode(path, episode)}
        for name, write in WRITERS.items():
            sides[name] = lambda write=write: write(path, *step_by_step(episode))
        seconds: dict[str, list[float]] = {name: [] for name in sides}
        for _ in range(repeats + 1):
            for name, write in sides.items():
                path.unlink(missing_ok=True)
                began = time.process_time()
                write()
                seconds[name].append(time.process_time() - began)
    medians = {name: float(np.median(times[1:])) for name, times in seconds.items()}
    return {
        name: {"messages_per_second": round(count / s), "MB_per_second": round(size / s, 1)}
        for name, s in medians.items()
    }


def _keep_up(task: str, robot: str, path: Path, seconds: float) -> dict[str, float]:
    """Write 1000 Hz joint states and two 256x256 cameras at 30 Hz as they come, at their own pace."""
    names, states, pictures = _filmed(task, robot)
    writer = McapWriter(path)
    writer.channel("/joint_states", "sensor_msgs/msg/JointState", {})
    for name in CAMERAS:
        writer.channel(f"/cameras/{name}", "sensor_msgs/msg/CompressedImage", {})
    layout = Layout.of(joint_state_pack(names), states.shape[1])
    block = StepBlock([BlockMessage(writer.number("/joint_states"), layout, False)])
    ticks, late, taken = round(seconds * JOINT_HZ), [], 0
    began, busy = time.perf_counter(), time.process_time()
    for tick in range(ticks):
        wait = began + tick / JOINT_HZ - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        late.append(max(0.0, -wait))
        stamp = time.time_ns()
        state = states[tick % len(states)]
        writer.records(block.fill(state[None], np.array([[stamp, stamp]])))
        if tick * CAMERA_HZ // JOINT_HZ >= taken:
            for name in CAMERAS:
                picture = pictures[name][taken % len(pictures[name])]
                writer.message(f"/cameras/{name}", stamp, cdr.pack_image(stamp, name, encode_png(picture)))
            taken += 1
    share = (time.process_time() - busy) / (time.perf_counter() - began)
    writer.finish()
    return {
        "share of a core": round(share, 3),
        "median lateness [s]": round(float(np.median(late)), 5),
        "largest lateness [s]": round(max(late), 4),
        "lateness at the end [s]": round(late[-1], 5),
        "joint states": float(ticks),
        "pictures": float(2 * taken),
        "MB/s on disk": round(path.stat().st_size / 1e6 / seconds, 2),
    }


def _filmed(task: str, robot: str) -> tuple[tuple[str, ...], np.ndarray, dict[str, list[np.ndarray]]]:
    """Names of the joints, their states at the physics' own rate, and pictures along the motion."""
    world = make_world(task, robot, 500)
    world.take_cameras(CAMERAS, height=SIDE, width=SIDE)
    seen = world.reset(np.random.default_rng(0))
    states, pictures = [], {name: [] for name in CAMERAS}
    rng = np.random.default_rng(1)
    for step in range(500):
        seen = world.step(rng.uniform(-0.3, 0.3, len(world.spec.action_low))).observation
        states.append(np.concatenate([seen["joint_pos"], seen["joint_vel"], seen["joint_effort"]]))
        if step % 17 == 0:
            for name, picture in world.pictures().items():
                pictures[name].append(picture)
    return world.spec.labels["joint_pos"], np.array(states), pictures
