"""`lfd bench convert`: recordings to a LeRobot dataset, beside LeRobot's own calls for the same rows.

LeRobot gets the rows as arrays in memory and calls `add_frame` and `save_episode`; ours reads MCAP files, writes, reads
everything again and compares every number. The limit is our writer alone, from arrays in memory.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lfd.convert.dataset.lerobot_writer import dataset_writer
from lfd.convert.features import ConvertRecipe
from lfd.convert.frames import EpisodeFrames
from lfd.convert.prepared import prepare
from lfd.convert.sources import SourceRecipe, frames_of, units_of
from lfd.convert.to_lerobot import convert
from lfd.core.processes import cores
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import as_table
from lfd.experts.playback import PlaybackPolicy
from lfd.record.episode_file import McapRecorder, Origin
from lfd.worlds.robosuite_world import make_world
from lfd.worlds.rollout import episode_rng, rollout

STATE = ("joint_pos", "joint_vel", "gripper_pos", "gripper_vel", "ee_pos", "ee_quat")
STEPS = 200
MEMORY = """
import sys
from pathlib import Path
from lfd.cli import main
main(sys.argv[1:])
peak = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
print(peak[0].split()[1])
"""


@dataclass(frozen=True, kw_only=True)
class ConvertBench:
    """What one run measured."""

    episodes: int
    frames: int
    frames_per_second: dict[str, float]
    """Side to frames a second of wall time; the faster of two runs."""
    ratios: dict[str, float]
    memory_mb: dict[str, float]
    """Number of episodes to the largest memory of a process that converts so many [MB]."""


def bench_convert(
    *, task: str, robot: str, episodes: int, many: int, seed: int, progress: Progress = silent
) -> ConvertBench:
    """Compare the sides on `episodes` episodes of 200 frames; memory also at `many` episodes.

    Raises `UnknownName` for a task or robot that lfd does not know.
    """
    with TemporaryDirectory() as folder, progress("bench convert", 6) as bar:
        recordings, at = Path(folder) / "recordings", iter(range(100))
        objects = _record(recordings, task, robot, episodes, seed)
        bar.advance(note=f"{episodes} episodes recorded")
        table = as_table(ConvertRecipe(state=STATE, environment_state=objects, action="action"))
        recipe = SourceRecipe(where="bench", tables={"convert": table})
        units = units_of([recordings], recipe)
        frames = [frames_of(unit, recipe)[0] for unit in units]
        count = sum(map(len, frames))

        def fresh() -> Path:
            return Path(folder) / f"dataset_{next(at)}"

        sides: dict[str, Callable[[], Any]] = {
            "lfd convert, one process": lambda: convert([recordings], fresh(), recipe=recipe, jobs=1),
            "limit: arrays to dataset": lambda: _write(frames, fresh()),
            "LeRobot's add_frame, save_episode": lambda: _write_with_lerobot(frames, fresh()),
        }
        rates = {}
        for name, run in sides.items():
            rates[name] = round(count / min(_seconds(run) for _ in range(2)), 1)
            bar.advance(note=f"{name}: {rates[name]:.0f} frames/s")
        memory = {}
        memory[str(episodes)], _ = _run(recordings, episodes, Path(folder), 1)
        bar.advance(note=f"{episodes} episodes: {memory[str(episodes)]:.0f} MB")
        memory[str(many)], alone = _run(recordings, many, Path(folder), 1)
        bar.advance(note=f"{many} episodes: {memory[str(many)]:.0f} MB")
        _, together = _run(recordings, many, Path(folder), cores())
    lerobot = rates["LeRobot's add_frame, save_episode"]
    ratios = {f"{name} vs LeRobot": round(rate / lerobot, 1) for name, rate in rates.items() if rate != lerobot}
    ratios[f"{cores()} processes vs one, {many} episodes"] = round(alone / together, 2)
    return ConvertBench(episodes=episodes, frames=count, frames_per_second=rates, ratios=ratios, memory_mb=memory)


def _seconds(run: Callable[[], Any]) -> float:
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def _record(out: Path, task: str, robot: str, episodes: int, seed: int) -> tuple[str, ...]:
    """Record episodes of random actions; returns the channels of the objects."""
    out.mkdir()
    world = make_world(task, robot, 20)
    rng = np.random.default_rng(seed)
    for index in range(episodes):
        actions = rng.uniform(-0.3, 0.3, (STEPS, len(world.spec.action_low)))
        origin = Origin(stage="record", policy="bench", seed=seed, index=index, recipe={})
        recorder = McapRecorder(out / f"episode_{index:06d}.mcap", origin, keep_failures=True)
        start = episode_rng("record", seed, index)
        rollout(world, PlaybackPolicy(actions), [recorder], start, horizon=STEPS, hold_steps=STEPS + 1)
    robots = ("joint_", "gripper_", "ee_")
    return tuple(name for name in world.spec.labels if name != "action" and not name.startswith(robots))


def _write(frames: Sequence[EpisodeFrames], out: Path) -> None:
    video = SourceRecipe(where="bench").video()
    out.mkdir()
    with dataset_writer(out) as writer:
        for episode in frames:
            writer.add(prepare(episode, video))


def _write_with_lerobot(frames: Sequence[EpisodeFrames], out: Path) -> None:
    import datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    datasets.disable_progress_bars()
    features = {
        name: {"dtype": str(rows.dtype), "shape": (rows.shape[1],), "names": list(frames[0].names[name])}
        for name, rows in frames[0].columns.items()
    }
    dataset = LeRobotDataset.create(
        "lfd/bench", fps=20, features=features, root=out, use_videos=False, video_backend="pyav"
    )
    for episode in frames:
        for row in range(len(episode)):
            dataset.add_frame({name: rows[row] for name, rows in episode.columns.items()} | {"task": episode.task})
        dataset.save_episode()
    dataset.finalize()


def _run(recordings: Path, episodes: int, folder: Path, jobs: int) -> tuple[float, float]:
    """Largest memory [MB] and wall time [s] of `lfd convert` for `episodes` episodes, the recordings in turn."""
    name, recipe = f"{episodes}_{jobs}", folder / "recipe.toml"
    many = folder / f"many_{name}"
    many.mkdir()
    there = sorted(recordings.glob("*.mcap"))
    for index in range(episodes):
        os.link(there[index % len(there)], many / f"episode_{index:06d}.mcap")
    recipe.write_text(f'[convert]\nstate = {list(STATE)}\nenvironment_state = []\naction = "action"\n')
    arguments = ["convert", many, "--recipe", recipe, "--jobs", jobs, "--out", folder / f"dataset_{name}"]
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", MEMORY, *map(str, arguments)], capture_output=True, text=True, check=True
    )
    return round(float(done.stdout.splitlines()[-1]) / 1024, 1), time.perf_counter() - began
