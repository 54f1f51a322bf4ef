"""`lfd bench train`: whether loading holds training up, beside LeRobot, robomimic, imitation and a bare loop.

All sides get the same made-up rows, of the size of a Lift demonstration, and one thread. They take turns, so that the
ratios hold on a machine that is busy or changes its clock: loading by the clock on the wall (LeRobot may use workers),
gradient steps by CPU time.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from lfd.bench import gradient_steps
from lfd.bench.loading import kinds_of, measure_loading
from lfd.bench.peers.process import Peer, PeerError, peer_python, peers_folder
from lfd.bench.turns import Side, take_turns
from lfd.convert.dataset.lerobot_writer import dataset_writer
from lfd.convert.dataset.video import VideoRecipe
from lfd.convert.exporting import export
from lfd.convert.frames import EpisodeFrames
from lfd.convert.prepared import prepare
from lfd.core.protocols import Bar, Progress, silent
from lfd.data.frames import Frames, load_frames

SIZES = {"observation.state": 25, "observation.environment_state": 10, "action": 7}
LENGTH = 200
TRAININGS: dict[str, tuple[tuple[int, ...], int]] = {
    "32x32, batch 32": ((32, 32), 32),
    "256x256, batch 256": ((256, 256), 256),
    "1024x1024, batch 100": ((1024, 1024), 100),
}
"""Name to hidden layers and batch size: what imitation, lfd and robomimic have by default."""
OURS, BARE, LEROBOT = "lfd", "limit: bare torch loop", "LeRobot's loop"
PEERS = {"robomimic": ("robomimic_steps.py", "rows.hdf5"), "imitation": ("imitation_steps.py", "rows.npz")}
"""Peer to its program, and the file of rows that it gets."""


@dataclass(frozen=True, kw_only=True)
class TrainBench:
    """What one run measured."""

    frames: int
    """Frames of the dataset, in episodes of 200."""
    frames_per_second: dict[str, dict[str, float]]
    """Kind of batch to side to frames a second, in the median turn."""
    loading_ratios: dict[str, dict[str, float]]
    """Kind of batch to ours as a multiple of another side."""
    steps_per_second: dict[str, dict[str, float]]
    """Network and batch to side to gradient steps a second, in the median turn."""
    step_ratios: dict[str, dict[str, float]]
    """Network and batch to ours as a multiple of another side."""
    missing: str
    """Why peers were left out; empty when they were not."""


def bench_train(
    *, episodes: int, turns: int, seconds: float, peers: bool, workers: bool, seed: int, progress: Progress = silent
) -> TrainBench:
    """Compare the sides on `episodes` episodes, in `turns` turns of `seconds` each.

    With `peers` robomimic and imitation take part, which are installed when they are not; with `workers` LeRobot's data
    loader is also tried with two.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with TemporaryDirectory() as folder, progress("bench train", 3 + len(TRAININGS)) as bar:
            root = Path(folder) / "dataset"
            make_dataset(root, episodes, seed)
            frames, loading, steps = load_frames(root), {}, {}
            for kind in kinds_of(frames):
                loading[kind] = measure_loading(root, kind, turns=turns, seconds=seconds, workers=workers)
                bar.advance(note=f"{kind}: {loading[kind][1]['vs LeRobot']:.0f}x LeRobot")
            python, missing = _peers(root, frames, bar) if peers else (None, "not asked for")
            for name, (hidden_sizes, batch_size) in TRAININGS.items():
                with _sides(root, python, hidden_sizes, batch_size) as sides:
                    taken = take_turns(sides, turns=turns, seconds=seconds)
                ratios = {f"vs {side}": taken.ratio(OURS, side) for side in sides if side != OURS}
                steps[name] = {side: taken.rate(side) for side in sides}, ratios
                bar.advance(note=f"{name}: {ratios[f'vs {BARE}']:.0%} of the bare loop")
    finally:
        torch.set_num_threads(threads)
    return TrainBench(
        frames=len(frames),
        frames_per_second={kind: _rounded(rates, 4) for kind, (rates, _) in loading.items()},
        loading_ratios={kind: _rounded(ratios, 4) for kind, (_, ratios) in loading.items()},
        steps_per_second={name: _rounded(rates, 4) for name, (rates, _) in steps.items()},
        step_ratios={name: _rounded(ratios, 4) for name, (_, ratios) in steps.items()},
        missing=missing,
    )


def make_dataset(root: Path, episodes: int, seed: int) -> None:
    """Write `episodes` episodes of 200 rows of random numbers."""
    rng = np.random.default_rng(seed)
    parts = dict(zip(SIZES, ("state", "object", "action"), strict=True))
    names = {name: tuple(f"{parts[name]}.{i}" for i in range(size)) for name, size in SIZES.items()}
    root.mkdir()
    with dataset_writer(root) as writer:
        for episode in range(episodes):
            columns = {name: rng.uniform(-1, 1, (LENGTH, size)).astype(np.float32) for name, size in SIZES.items()}
            units = {name: ("1",) * size for name, size in SIZES.items()}
            source = f"made-up episode {episode}"
            frames = EpisodeFrames(source=source, fps=20, task="none", columns=columns, names=names, units=units)
            writer.add(prepare(frames, VideoRecipe()))


PROGRAMS = Path(__file__).with_name("peers")


@contextmanager
def _sides(
    root: Path, python: Path | None, hidden_sizes: tuple[int, ...], batch_size: int
) -> Iterator[dict[str, Side]]:
    made = OURS, BARE, LEROBOT
    makers = gradient_steps.ours, gradient_steps.bare, gradient_steps.lerobot
    sides = {name: make(root, hidden_sizes, batch_size) for name, make in zip(made, makers, strict=True)}
    with ExitStack() as stack:
        if python is not None:
            for name, (program, rows) in PEERS.items():
                peer = Peer(
                    python, PROGRAMS / program, root.parent / rows, hidden_sizes=hidden_sizes, batch_size=batch_size
                )
                sides[name] = stack.enter_context(peer)
        yield sides


def _peers(root: Path, frames: Frames, bar: Bar) -> tuple[Path | None, str]:
    """The peers' Python, with the dataset in the files that they read beside it; or why there is none."""
    try:
        python = peer_python(peers_folder(), lambda note: bar.advance(0, note))
    except PeerError as error:  # without a network the rest is still worth measuring
        bar.advance(0, f"without robomimic and imitation: {error}")
        return None, str(error)
    export([root], root.parent / "rows.hdf5", to="robomimic")
    rows: dict[str, Any] = {name: rows.numpy() for name, rows in frames.columns.items()}
    np.savez(root.parent / "rows.npz", **rows)
    return python, ""


def _rounded(values: dict[str, float], digits: int) -> dict[str, float]:
    """Values to so many digits that count."""
    return {name: float(f"{value:.{digits}g}") for name, value in values.items()}
