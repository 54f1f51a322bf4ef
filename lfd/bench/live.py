"""What it costs to be watched (`--live`), in turn with and without, with somebody who receives all that is sent.

Times are of the processor, so that they hold on a machine that is busy; the viewer's server counts, too.
"""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from lfd.bench.bootstrap import median_interval
from lfd.convert.to_lerobot import convert
from lfd.core.protocols import Observer, Observers, unwatched
from lfd.core.recipe import build, load_toml
from lfd.experts.playback import PlaybackPolicy
from lfd.loops.dagger_recipe import DATA_TABLES, LEARN_TABLES
from lfd.record.demonstrations import RecordRecipe, record
from lfd.record.episode_file import McapRecorder, Origin
from lfd.record.pacing import Paced
from lfd.replay.live_worlds import RATE, LiveWorlds, live_curves
from lfd.replay.rerun_live import RerunBoard, serving
from lfd.replay.viewer_process import HOST, program
from lfd.run.trial import EvalRecipe, Trial
from lfd.train.behavior_cloning import train
from lfd.train.recipe import TrainRecipe
from lfd.worlds.robosuite_world import RobosuiteWorld
from lfd.worlds.rollout import episode_rng, rollout

CONTROL_HZ, SECONDS = 20, 10.0
SERVER = "--serve-web"
"""By which the server is found among the processes."""
DEMONSTRATED = Path("datasets/lift_panda.toml")
LEARNED = Path("policies/bc_mlp.toml")
DEMONSTRATIONS = 10
SHORT = 10
"""Pairs at full speed for each one in real time."""


def bench_live(
    world: RobosuiteWorld, folder: Path, *, pairs: int, episodes: int, gradient_steps: int, seed: int
) -> dict[str, list[float]]:
    """What it costs recording, evaluating over `episodes` and training over `gradient_steps` to be watched.

    Medians, with the ends of their 95% intervals where they are of pairs.

    Drawing takes the same time of a core however fast the world is, so it is measured on a world that runs in real
    time and has little else to do; at full speed the rest shows, keeping states, in what else is noise.
    """
    found: dict[str, list[float]] = {}
    with serving() as (_, source), _reader(source, folder / "read.rrd"):
        board = LiveWorlds(RerunBoard(source, "bench", [RATE], scenes=1))

        def recorded(observers: Observers, *, paced: bool) -> tuple[float, float]:
            began, wall = _spent(), time.perf_counter()
            record_random(world, folder / "live.mcap", seed, observers(0), paced=paced)
            return _spent() - began, time.perf_counter() - wall

        first, _ = recorded(board.begin(), paced=False)  # loads the model and sends its shapes
        second, _ = recorded(unwatched, paced=False)
        of_a_core = []
        for _ in range(pairs):
            (seen, wall), (alone, _) = (recorded(watching, paced=True) for watching in (board.begin(), unwatched))
            of_a_core.append((seen - alone) / wall)
        found["share of a core for a world that is watched"] = median_interval(np.array(of_a_core))
        found["processor time of recording at full speed, watched to not"] = _ratio(
            lambda: recorded(board.begin(), paced=False),
            lambda: recorded(unwatched, paced=False),
            pairs,
        )
        policy, dataset = _learned(world, folder, seed)
        trial = Trial.of(policy, build(EvalRecipe, load_toml(LEARNED, LEARN_TABLES)["eval"] | {"seed": seed}, "[eval]"))

        def tried(observers: Observers) -> None:
            for _ in trial.run([world], "eval", range(episodes), observers):
                pass

        found["processor time of evaluation at full speed, watched to not"] = _ratio(
            lambda: tried(board.begin()), lambda: tried(unwatched), pairs
        )
        board.close()
    with live_curves(lambda _address: None) as report:
        found["processor time of training, watched to not"] = _ratio(
            lambda: _trained(dataset, folder / "seen", gradient_steps, seed, report),
            lambda: _trained(dataset, folder / "alone", gradient_steps, seed),
            pairs,
        )
    return found | {"to begin [s]": [max(0.0, first - second)]}


def record_random(
    world: RobosuiteWorld, path: Path, seed: int, watching: Sequence[Observer] = (), *, paced: bool = False
) -> None:
    """Record an episode of small random actions, as fast as it goes or in real time."""
    steps, size = round(SECONDS * CONTROL_HZ), len(world.spec.action_low)
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (steps, size))
    origin = Origin(stage="record", policy="bench", seed=seed, index=0, recipe={})
    observers = [McapRecorder(path, origin, keep_failures=True), *watching]
    start = episode_rng("record", seed, 0)
    policy = PlaybackPolicy(actions)
    rollout(
        world, Paced(policy, CONTROL_HZ) if paced else policy, observers, start, horizon=steps, hold_steps=steps + 1
    )


def _learned(world: RobosuiteWorld, folder: Path, seed: int) -> tuple[Path, Path]:
    """A policy that was trained for a moment, and its dataset."""
    tables = load_toml(DEMONSTRATED, DATA_TABLES)
    task, robot = world.spec.task, world.spec.robot
    own = tables["record"] | {"task": task, "robot": robot, "episodes": DEMONSTRATIONS, "seed": seed}
    record(build(RecordRecipe, own, "[record]"), folder / "recordings", tables=tables | {"record": own}, most_worlds=1)
    dataset = folder / "dataset"
    convert([folder / "recordings"], dataset)
    _trained(dataset, folder / "policy", 300, seed)
    return folder / "policy", dataset


def _trained(
    dataset: Path, out: Path, steps: int, seed: int, report: Callable[[dict[str, float | int]], None] | None = None
) -> None:
    learn = load_toml(LEARNED, LEARN_TABLES)
    recipe = replace(build(TrainRecipe, learn["train"], "[train]"), steps=steps, seed=seed)
    train(learn["policy"], recipe, dataset, out, tables=learn, report=report, overwrite=True)


def _ratio(seen: Callable[[], object], alone: Callable[[], object], pairs: int) -> list[float]:
    """Processor time of one over that of the other, the median over many short pairs, since a machine's speed drifts.

    Each comes first in every second pair.
    """
    times = np.empty((SHORT * pairs, 2))
    for pair in range(SHORT * pairs):
        for which in (0, 1) if pair % 2 == 0 else (1, 0):
            began = _spent()
            (seen, alone)[which]()
            times[pair, which] = _spent() - began
    return median_interval(times[:, 0] / times[:, 1])


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
