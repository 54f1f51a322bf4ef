"""`lfd bench replay`: how much faster than real time episodes become Rerun files, how large these are, what being
watched costs.

Times are of the processor, so that they hold on a machine that is busy. What it costs to be watched is measured on the
same worlds with and without, in turn, with somebody who receives all that is sent; the server's time counts too.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lfd.bench.live import CONTROL_HZ, SECONDS, bench_live, record_random
from lfd.core.protocols import Progress, silent
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
from lfd.replay import shown_mesh
from lfd.replay.clip import Clip, kept_model, recording_clip
from lfd.replay.rerun_scene import replay
from lfd.worlds.robosuite_world import RobosuiteWorld, make_world

CAMERAS, SIDE = ("agentview", "robot0_eye_in_hand"), 128


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
    live: dict[str, list[float]]
    """What it costs to be watched, with the ends of an interval."""


def bench_replay(
    *,
    task: str,
    robot: str,
    repeats: int,
    pairs: int,
    episodes: int,
    gradient_steps: int,
    every_kind: bool,
    seed: int,
    progress: Progress = silent,
) -> ReplayBench:
    """Measure files over `repeats`, being watched over `pairs` of runs; corrections and cameras with `every_kind`.

    `episodes` and `gradient_steps` are those of an evaluation and a training that are watched.

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
        live = bench_live(world, folder, pairs=pairs, episodes=episodes, gradient_steps=gradient_steps, seed=seed)
        bar.advance()
    return ReplayBench(task=task, robot=robot, real_time=real_time, once=once, megabytes=megabytes, live=live)


def _recordings(world: RobosuiteWorld, folder: Path, *, every_kind: bool, seed: int) -> dict[str, Path]:
    """A recording of each kind."""
    spec = world.spec
    made = {f"{spec.task}, {SECONDS:g} s at {CONTROL_HZ} Hz": folder / "plain.mcap"}
    record_random(world, folder / "plain.mcap", seed)
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
    record_random(filmed, folder / "filmed.mcap", seed)
    made[f"the same with {len(CAMERAS)} cameras of {SIDE} x {SIDE}"] = folder / "filmed.mcap"
    pushed = CorrectionRecipe(task="laptop", robot=spec.robot, runs=1, seed=seed)
    setup = set_up(pushed)
    learner, person = learner_of(start_reward(pushed), pushed), scripted(pushed, setup)
    correct(pushed, setup, learner, person, make_correction_world(pushed), out=folder / "corrected")
    made[f"a correction, {pushed.duration_s:g} s at {pushed.control_hz} Hz"] = next(
        (folder / "corrected").glob("*.mcap")
    )
    return made


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
