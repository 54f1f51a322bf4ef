"""Frames a second in batches: LeRobot's dataset with torch's data loader, ours, and an index gather alone.

A batch is plain, has ACT's chunk of 100 actions, or Diffusion Policy's two observations and 16 actions. Ours are
compared with LeRobot's bit for bit before anything is timed.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lfd.bench.turns import by_wall_clock, take_turns
from lfd.core.errors import VerificationError
from lfd.data.batches import Batches
from lfd.data.frames import Frames, load_frames
from lfd.data.windows import Deltas, Windows

BATCH = 64
LEROBOT, WORKERS, OURS, GATHER = (
    "LeRobotDataset and DataLoader", "the same with 2 workers", "lfd", "limit: index gather alone",
)  # fmt: skip


def kinds_of(frames: Frames) -> dict[str, Deltas]:
    """Kind of batch to its windows."""
    return {
        "plain": dict.fromkeys(frames.columns),
        "chunks of 100": {**dict.fromkeys(frames.columns), "action": range(100)},
        "horizon 16": {**dict.fromkeys(frames.columns, range(-1, 1)), "action": range(-1, 15)},
    }


def measure_loading(
    root: Path, kind: str, *, turns: int, seconds: float, workers: bool
) -> tuple[dict[str, float], dict[str, float]]:
    """Frames a second of every side, and ratios; LeRobot's is the better of 0 and 2 `workers` where both are measured.

    Raises `VerificationError` when a batch is not LeRobot's.
    """
    frames = load_frames(root)
    deltas = kinds_of(frames)[kind]
    dataset = lerobot_dataset(root, deltas, frames.fps)
    windows = Windows(frames.columns, frames.episode_index, deltas)
    check_batches(dataset, windows, kind)
    sampler = Batches(torch.arange(len(frames)), BATCH, torch.Generator().manual_seed(0))
    loaded = endless(dataset, BATCH)
    gather = _gather(frames.columns, deltas, sampler)
    sides = {
        LEROBOT: by_wall_clock(lambda: next(loaded)),
        OURS: by_wall_clock(lambda: windows.batch(sampler.next_index())),
        GATHER: by_wall_clock(gather),
    }
    taken = take_turns(sides, turns=turns, seconds=seconds)
    rates = {name: BATCH * taken.rate(name) for name in sides}
    faster = 1.0
    if workers:
        rates[WORKERS] = BATCH * _rate_of_workers(dataset, seconds)
        faster = max(1.0, rates[WORKERS] / rates[LEROBOT])
    ratios = {"vs LeRobot": taken.ratio(OURS, LEROBOT) / faster, "vs index gather": taken.ratio(OURS, GATHER)}
    return rates, ratios


def check_batches(dataset: Any, windows: Windows, kind: str) -> None:
    """Compare frames at an episode's ends, and some between, with LeRobot's data loader.

    Raises `VerificationError` where a bit differs.
    """
    from torch.utils.data import DataLoader

    index = torch.arange(0, len(windows), max(1, len(windows) // 61))[:BATCH]
    theirs = next(iter(DataLoader(dataset, batch_size=len(index), sampler=index.tolist())))
    for name, rows in windows.batch(index).items():
        if not torch.equal(rows, theirs[name]):
            raise VerificationError(f"{name} of a batch ({kind}) is not what LeRobot gives")


def endless(dataset: Any, batch_size: int, **options: Any) -> Iterator[dict[str, Any]]:
    """LeRobot's batches, with its sampler, epoch after epoch."""
    from lerobot.datasets.sampler import EpisodeAwareSampler
    from lerobot.utils.utils import cycle
    from torch.utils.data import DataLoader

    episodes = dataset.meta.episodes
    sampler = EpisodeAwareSampler(episodes["dataset_from_index"], episodes["dataset_to_index"], shuffle=True)
    return cycle(DataLoader(dataset, batch_size=batch_size, sampler=sampler, **options))


def lerobot_dataset(root: Path, deltas: Deltas, fps: float) -> Any:
    """LeRobot's own view of the dataset `root`."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    import datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    datasets.disable_progress_bars()
    asked = {name: [delta / fps for delta in window] for name, window in deltas.items() if window is not None}
    return LeRobotDataset("lfd/bench", root=root, delta_timestamps=asked or None, video_backend="pyav")


def _gather(columns: Mapping[str, Tensor], deltas: Deltas, sampler: Batches) -> Callable[[], Any]:
    """Rows by number, with no regard to where an episode ends."""
    last = len(next(iter(columns.values()))) - 1
    offsets = {name: None if window is None else torch.tensor(list(window)) for name, window in deltas.items()}

    def take() -> dict[str, Tensor]:
        index, batch = sampler.next_index(), {}
        for name, rows in columns.items():
            offset = offsets[name]
            batch[name] = rows[index] if offset is None else rows[(index[:, None] + offset).clamp_(0, last)]
        return batch

    return take


def _rate_of_workers(dataset: Any, seconds: float) -> float:
    """Batches a second of two workers, once they are up and what they had prepared is used up."""
    ahead = 2 * 4
    loaded = endless(
        dataset, BATCH, num_workers=2, prefetch_factor=4, persistent_workers=True, multiprocessing_context="spawn"
    )
    for _ in range(1 + ahead):
        next(loaded)
    run = by_wall_clock(lambda: next(loaded))
    batches, took = 0, 0.0
    while took < 3 * seconds or batches < 2 * ahead:
        took += run(1)
        batches += 1
    return batches / took
