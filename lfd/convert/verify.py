"""The proof that a dataset holds its sources: both are read and every number is compared."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.dataset.lerobot_writer import INFO
from lfd.convert.frames import EpisodeFrames, Pictures
from lfd.convert.sources import SourceRecipe, Unit, frames_of, units_of
from lfd.core.errors import VerificationError
from lfd.core.processes import ProcessMap
from lfd.core.protocols import Progress, silent
from lfd.record.png import decode_png

LEAST_PSNR_DB = 20.0
"""Video frames that are further from their pictures are no frames of these pictures [dB]."""
CLEARLY_DB, SHIFTED_DB = 3.0, 1.0
"""By how much a frame is nearer to another picture when it is that one's, and by how much many frames are [dB]."""
CLOSE, SOME = 10, 20
"""Rows on either side that a doubtful frame is compared with, and frames that are compared with the rows beside."""
Placed = tuple[Unit, int]
"""A unit, and the number of its first episode in the dataset."""


def verify(
    dataset: Path, sources: Sequence[Path], *, recipe: SourceRecipe | None = None, progress: Progress = silent
) -> int:
    """Read a dataset and its sources, and compare counts, numbers, units, tasks and episode boundaries.

    The dataset's numbers are float32. Pictures are compared to the bit where they are kept as such, and by their
    distance where they are videos. What the conversion skipped is passed over. Without a `recipe`, the one in the
    dataset's manifest is used, else the one in each recording. Returns how many numbers were compared.

    Raises `VerificationError` at the first difference.
    """
    files = DatasetFiles(dataset)
    recipe = recipe or SourceRecipe.kept(files.manifest, f"{dataset} manifest.json")
    skipped = files.manifest.get("skipped", {})
    units = [unit for unit in units_of(sources, recipe) if unit.key not in skipped]
    recipe = recipe.completed(units)
    at = compared = 0
    with progress("verify", len(units)) as bar:
        for unit in units:
            episodes, numbers = _compare_unit(files, recipe, unit, at)
            at, compared = at + episodes, compared + numbers
            bar.advance(note=f"{compared} numbers equal")
    _compare("number of episodes", len(files), at)
    _compare("number of frames", files.info["total_frames"], sum(row["length"] for row in files.episodes))
    return compared


def verify_placed(
    dataset: Path, placed: Sequence[Placed], recipe: SourceRecipe, run: ProcessMap, progress: Progress = silent
) -> int:
    """Compare units with the episodes that were made of them; returns how many numbers were compared.

    Raises `VerificationError` at the first difference.
    """
    compared = 0
    with progress("verify", len(placed)) as bar:
        for _, (_, numbers) in run(_verify_unit, (dataset, recipe), placed):
            compared += numbers
            bar.advance(note=f"{compared} numbers equal")
    return compared


def _verify_unit(shared: tuple[Path, SourceRecipe], placed: Placed) -> tuple[int, int]:
    """Compare a unit; returns its number of episodes and of numbers."""
    (dataset, recipe), (unit, first) = shared, placed
    return _compare_unit(_files(dataset, (dataset / INFO).stat().st_mtime_ns), recipe, unit, first)


def _compare_unit(files: DatasetFiles, recipe: SourceRecipe, unit: Unit, first: int) -> tuple[int, int]:
    episodes = frames_of(unit, recipe)
    return len(episodes), sum(_compare_episode(files, first + i, frames) for i, frames in enumerate(episodes))


@lru_cache(maxsize=1)
def _files(dataset: Path, changed: int) -> DatasetFiles:
    del changed  # a dataset that has changed is read again
    return DatasetFiles(dataset)


def _compare_episode(files: DatasetFiles, index: int, frames: EpisodeFrames) -> int:
    where = f"{frames.source} as episode {index}"
    if index >= len(files):
        raise VerificationError(f"number of episodes: the dataset says {len(files)}, the recordings have more")
    _compare(f"{where}: rate", files.fps, frames.fps)
    row = files.episodes[index]
    begin = files.episodes[index - 1]["dataset_to_index"] if index else 0
    _compare(f"{where}: rows", (row["dataset_from_index"], row["dataset_to_index"]), (begin, begin + len(frames)))
    _compare(f"{where}: task", list(row["tasks"]), [frames.task])
    stored = files.read(index)
    own: dict[str, Any] = {
        "episode_index": np.full(len(frames), index),
        "frame_index": np.arange(len(frames)),
        "index": np.arange(begin, begin + len(frames)),
        "timestamp": (np.arange(len(frames)) / frames.fps).astype(np.float32),
    }
    expected = {**frames.columns, **{name: rows[:, None] for name, rows in own.items()}}
    features = {*stored.columns, *stored.pngs, *(n for n, told in files.features.items() if told["dtype"] == "video")}
    _compare(f"{where}: features", sorted(features - {"task_index"}), sorted({*expected, *frames.pictures}))
    compared = 0
    for name, rows in expected.items():
        _compare(f"{where}: shape of {name}", stored.columns[name].shape, rows.shape)
        if not np.array_equal(stored.columns[name], rows):
            at = int(np.argmax((stored.columns[name] != rows).any(axis=1)))
            raise VerificationError(f"{where}: {name} differs from the recording in row {at}; convert it again")
        if name in files.manifest.get("units", {}):
            _compare(f"{where}: units of {name}", list(files.units(name)), list(frames.units[name]))
        compared += rows.size
    _compare(f"{where}: task of the rows", {files.tasks[t] for t in stored.columns["task_index"][:, 0]}, {frames.task})
    return compared + sum(_compare_pictures(files, index, name, frames, where, stored.pngs) for name in frames.pictures)


def _compare_pictures(
    files: DatasetFiles, index: int, name: str, frames: EpisodeFrames, where: str, pngs: dict[str, list[bytes]]
) -> int:
    is_video, pictures = name not in pngs, frames.pictures[name]
    stored = files.video(index, name) if is_video else [decode_png(data) for data in pngs[name]]
    _compare(f"{where}: number of pictures of {name}", len(stored), len(pictures))
    same = _same_video if is_video else _same_pictures
    for row in same(stored, pictures):
        raise VerificationError(f"{where}: picture {row} of {name} is another than in the recording; convert it again")
    return sum(picture.size for picture in stored)


def _same_pictures(stored: Sequence[np.ndarray], pictures: Pictures) -> Iterator[int]:
    """Rows whose picture is not that of the recording to the bit."""
    for row, (there, here) in enumerate(zip(stored, pictures, strict=True)):
        if there.shape != here.shape or (there != here).any():
            yield row


def _same_video(stored: Sequence[np.ndarray], pictures: Pictures) -> Iterator[int]:
    """Rows whose frame is far from its picture, or clearly nearer to the picture of a row close by.

    Only frames that are further from their picture than others of the video are compared with other rows; where all
    are a row late or early, some are enough to see it.
    """
    found = []
    for row, (there, here) in enumerate(zip(stored, pictures, strict=True)):
        if there.shape != here.shape:
            yield row
            return
        found.append(_psnr(there, here))
    usual, last = float(np.median(found)), len(found) - 1
    if usual < LEAST_PSNR_DB:
        yield int(np.argmin(found))
    for row in (row for row, near in enumerate(found) if near < usual - CLEARLY_DB):
        close = range(max(0, row - CLOSE), min(last, row + CLOSE) + 1)
        nearest = max(_psnr(stored[row], pictures[other]) for other in close)
        if found[row] < LEAST_PSNR_DB or nearest > found[row] + CLEARLY_DB:
            yield row
    for shift in (-1, 1):
        rows = range(1, last, 1 + last // SOME)
        if rows and np.mean([_psnr(stored[row], pictures[row + shift]) - found[row] for row in rows]) > SHIFTED_DB:
            yield rows[0]


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal to noise ratio of two pictures [dB], 100 for equal ones."""
    error = float(np.square(a.astype(np.float32) - b).mean())
    return min(100.0, 10 * np.log10(255**2 / error)) if error else 100.0


def _compare(what: str, read: Any, expected: Any) -> None:
    if read != expected:
        raise VerificationError(f"{what}: the dataset says {read}, the recordings say {expected}; convert them again")
