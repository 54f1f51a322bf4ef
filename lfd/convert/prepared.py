"""An episode ready to be written: rows, pictures or videos encoded, statistics computed.

All that costs time happens here, in whichever process reads the source; what is left for the writer is to append.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lfd.convert.dataset.statistics import Stats, column_stats, picture_stats, sampled_rows
from lfd.convert.dataset.video import PNG, VideoRecipe, encode_video, video_info
from lfd.convert.frames import EpisodeFrames, Pictures
from lfd.core.errors import DatasetError
from lfd.record.png import encode_png

Picture = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True, kw_only=True)
class PreparedEpisode:
    """Everything that a dataset keeps of an episode, but for the numbers that depend on the episodes before it."""

    source: str
    fps: int
    task: str
    columns: Mapping[str, np.ndarray]
    """Feature to its rows (T, D), float32 or bool."""
    pngs: Mapping[str, list[bytes]]
    """Feature to its pictures, where they are kept without loss."""
    videos: Mapping[str, bytes]
    """Feature to its MP4 file."""
    stats: Mapping[str, Stats]
    features: Mapping[str, dict[str, Any]]
    """LeRobot's description of the features, in order."""
    units: Mapping[str, tuple[str, ...]]
    about: Mapping[str, Any]
    notes: Mapping[str, Any]
    recipe: Mapping[str, Any]
    model_xml: str

    def __len__(self) -> int:
        return len(next(iter((*self.columns.values(), *self.pngs.values()))))


def prepare(frames: EpisodeFrames, video: VideoRecipe) -> PreparedEpisode:
    """Encode an episode's pictures and compute its statistics.

    Raises `DatasetError` for pictures that change their size, or that the codec does not take.
    """
    features = {name: _vector(rows, frames.names[name]) for name, rows in frames.columns.items()}
    stats = column_stats(frames.columns)
    pngs, videos = {}, {}
    for name, pictures in frames.pictures.items():
        where, sampled = f"{frames.source}: {name}", list[Picture]()
        passing = _passing(pictures, sampled, where, frames.fps)
        if video.codec == PNG:
            pngs[name] = [encode_png(picture) for picture in passing]
        else:
            videos[name] = encode_video(passing, frames.fps, video, where)
        stats[name] = picture_stats(sampled)
        height, width, _ = sampled[0].shape
        features[name] = {"dtype": "image", "shape": (height, width, 3), "names": ["height", "width", "channels"]}
        if name in videos:
            features[name] |= {"dtype": "video", "info": video_info(height, width, frames.fps, video)}
    return PreparedEpisode(
        source=frames.source,
        fps=frames.fps,
        task=frames.task,
        columns=frames.columns,
        pngs=pngs,
        videos=videos,
        stats=stats,
        features=features,
        units=frames.units,
        about=frames.about,
        notes=frames.notes,
        recipe=frames.recipe,
        model_xml=frames.model_xml,
    )


def _passing(pictures: Pictures, sampled: list[Picture], where: str, fps: int) -> Iterator[Picture]:
    """The pictures one after another; those for the statistics are kept on the way.

    Raises `DatasetError` where their size changes.
    """
    wanted, size = set(sampled_rows(len(pictures))), ()
    for row, picture in enumerate(pictures):
        size = size or picture.shape
        if picture.shape != size:
            was, now = (f"{shape[1]} x {shape[0]}" for shape in (size, picture.shape))
            raise DatasetError(f"{where} changes its size from {was} to {now} in row {row} ({row / fps:.3f} s)")
        if row in wanted:
            sampled.append(picture)
        yield picture


def _vector(rows: np.ndarray, names: tuple[str, ...]) -> dict[str, Any]:
    kind = "bool" if rows.dtype == bool else "float32"
    return {"dtype": kind, "shape": (rows.shape[1],), "names": list(names) if kind == "float32" else None}
