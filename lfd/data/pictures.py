"""The pictures of a dataset as tensors in memory, each file decoded once from its beginning to its end."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from jaxtyping import UInt8

from lfd.convert.dataset.dataset_files import UNREADABLE, DatasetFiles
from lfd.core.errors import DatasetError, RecordingError
from lfd.core.protocols import Progress
from lfd.record.png import decode_png

Picture = UInt8[np.ndarray, "H W 3"]


def camera_features(files: DatasetFiles) -> tuple[str, ...]:
    """The features of a dataset that are pictures of an observation."""
    return tuple(
        name
        for name, told in files.features.items()
        if told["dtype"] in ("image", "video") and name.startswith("observation.")
    )


def load_pictures(
    files: DatasetFiles, features: tuple[str, ...], progress: Progress
) -> dict[str, UInt8[torch.Tensor, "N 3 H W"]]:
    """Feature to the pictures of all frames, RGB.

    Raises `DatasetError` for pictures that cannot be decoded, that are no RGB of one size, or that would take more than
    half of this machine's memory.
    """
    count = files.info["total_frames"]
    sizes = {name: _size(files, name) for name in features}
    need, have = sum(count * 3 * h * w for h, w in sizes.values()), _memory()
    if need > have / 2:
        told = ", ".join(f"{name} of {w} x {h}" for name, (h, w) in sizes.items())
        raise DatasetError(
            f"the pictures of {files.root} ({count} frames with {told}) take {need / 1e9:.1f} GB in memory, more than "
            f"half of this machine's {have / 1e9:.1f} GB; convert with fewer cameras ([convert] cameras), record "
            "smaller pictures ([record] camera_height, camera_width), or train a policy that takes no pictures"
        )
    loaded = {}
    with progress("load pictures", count * len(features)) as bar:
        for name, size in sizes.items():
            rows = np.empty((count, 3, *size), np.uint8)
            reader = _from_videos if files.features[name]["dtype"] == "video" else _from_tables
            done = 0
            for row, picture in reader(files, name):
                if picture.shape != (*size, 3):
                    raise DatasetError(f"{files.root}: {name} is {picture.shape} in row {row}, expected {(*size, 3)}")
                rows[row] = picture.transpose(2, 0, 1)
                bar.advance()
                done += 1
            if done != count:
                raise DatasetError(f"{files.root}: {name} has {done} pictures of {count} frames; convert again")
            loaded[name] = torch.from_numpy(rows)
    return loaded


def _from_tables(files: DatasetFiles, feature: str) -> Iterator[tuple[int, Picture]]:
    """Rows and their pictures, where these are kept as PNG beside the numbers."""
    row = 0
    for path in sorted((files.root / "data").rglob("*.parquet")):
        for some in _read(path, lambda path=path: pq.ParquetFile(path).iter_batches(64, columns=[feature])):
            for stored in some[feature].to_pylist():
                try:
                    yield row, decode_png(stored["bytes"] or b"")
                except RecordingError as error:
                    raise DatasetError(f"{path}: {feature} in row {row} is no picture; convert again") from error
                row += 1


def _from_videos(files: DatasetFiles, feature: str) -> Iterator[tuple[int, Picture]]:
    """Rows and their pictures, where these are kept as videos of one or more episodes each."""
    places: dict[Path, dict[int, int]] = {}
    for row in files.episodes:
        place = {key: row[f"videos/{feature}/{key}"] for key in ("chunk_index", "file_index")}
        path = files.root / files.info["video_path"].format(video_key=feature, **place)
        begin = round(row[f"videos/{feature}/from_timestamp"] * files.fps)
        numbers = range(row["dataset_from_index"], row["dataset_to_index"])
        places.setdefault(path, {}).update(enumerate(numbers, begin))
    for path, rows in places.items():
        for number, picture in _read(path, lambda path=path: _frames(path, float(files.fps))):
            if number in rows:
                yield rows[number], picture


def _frames(path: Path, fps: float) -> Iterator[tuple[int, Picture]]:
    """The numbers and pictures of a video's frames."""
    import av

    with av.open(str(path)) as video:
        for frame in video.decode(video=0):
            yield round((frame.time or 0) * fps), frame.to_ndarray(format="rgb24")


def _read[Item](path: Path, items: Callable[[], Iterator[Item]]) -> Iterator[Item]:
    """What a file gives; damage becomes a sentence."""
    try:
        yield from items()
    except UNREADABLE as error:
        raise DatasetError(f"{path} cannot be read ({error}); convert the recordings again") from error


def _size(files: DatasetFiles, feature: str) -> tuple[int, int]:
    """Height and width; LeRobot's own datasets have the channels first or last."""
    told: dict[str, Any] = files.features[feature]
    names, shape = told.get("names") or ("height", "width", "channels"), tuple(told["shape"])
    by_name = dict(zip(names, shape, strict=False))
    height, width = by_name.get("height", 0), by_name.get("width", 0)
    if len(shape) != 3 or sorted(shape) != sorted((height, width, 3)):
        raise DatasetError(
            f"{files.root}: {feature} has the shape {shape} of {tuple(names)}, expected RGB pictures; "
            "`lerobot-edit-dataset --operation.type remove_feature` leaves it out"
        )
    return height, width


def _memory() -> int:
    """Memory of this machine [bytes]."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
