"""Reads LeRobot v3 datasets, ours and others', episode by episode and without a copy in any cache."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import UInt8

from lfd.convert.dataset.lerobot_writer import INFO, TASKS
from lfd.convert.dataset.video import decode_video
from lfd.core.artifact import read_manifest
from lfd.core.errors import DatasetError

UNREADABLE = (pa.ArrowException, OSError, ValueError, KeyError)


@dataclass(frozen=True)
class StoredEpisode:
    """An episode as a dataset has it."""

    index: int
    tasks: tuple[str, ...]
    columns: dict[str, np.ndarray]
    """Feature to its rows (T, D), without pictures."""
    pngs: dict[str, list[bytes]]
    """Feature to its pictures as files, where they are kept as such."""


class DatasetFiles:
    """The dataset in the folder `root`.

    Raises `DatasetError` for a folder that is none, or whose files do not belong together.
    """

    def __init__(self, root: Path):
        if not (root / INFO).is_file():
            raise DatasetError(f"{root} is no LeRobot dataset: it has no {INFO}; `lfd convert` makes one of recordings")
        self.root = root
        try:
            self.info: dict[str, Any] = json.loads((root / INFO).read_text(encoding="utf-8"))
        except ValueError as error:
            raise DatasetError(f"{root / INFO} is no JSON ({error}); convert the recordings again") from error
        version = str(self.info.get("codebase_version"))
        if not version.startswith("v3"):
            raise DatasetError(f"{root} is a LeRobot dataset of version {version}, expected v3.0")
        self.features: dict[str, dict[str, Any]] = self.info["features"]
        self.fps = self.info["fps"]
        self.manifest = read_manifest(root) or {}
        self._open: tuple[Path, _Rows] | None = None

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.episodes)

    @cached_property
    def episodes(self) -> list[dict[str, Any]]:
        """The description of every episode, in order, without its statistics."""
        rows = []
        for path in sorted((self.root / "meta" / "episodes").rglob("*.parquet")):
            with _reading(path):
                names = [name for name in pq.read_schema(path).names if not name.startswith("stats/")]
                rows += pq.read_table(path, columns=names).to_pylist()
        rows.sort(key=lambda row: row["episode_index"])
        if [row["episode_index"] for row in rows] != list(range(self.info["total_episodes"])):
            raise DatasetError(
                f"{self.root} describes {len(rows)} episodes, {INFO} says {self.info['total_episodes']}; convert again"
            )
        return rows

    @cached_property
    def tasks(self) -> dict[int, str]:
        """Number to text."""
        with _reading(self.root / TASKS):
            table = pq.read_table(self.root / TASKS).to_pydict()
        names = table.get("task", table.get("__index_level_0__"))
        return dict(zip(table["task_index"], names or [], strict=True))

    def read(self, index: int) -> StoredEpisode:
        """The rows of an episode."""
        row = self.episodes[index]
        rows = self._rows_of(row)
        columns, pngs = {}, {}
        for name, told in self.features.items():
            if told["dtype"] == "image":
                pngs[name] = [value["bytes"] for value in rows[name].to_pylist()]
            elif told["dtype"] != "video" and told["dtype"] != "string":
                columns[name] = _rows(rows[name])
        return StoredEpisode(index, tuple(row["tasks"]), columns, pngs)

    def video(self, index: int, feature: str) -> list[UInt8[np.ndarray, "H W 3"]]:
        """The pictures of an episode in a video feature, decoded."""
        row = self.episodes[index]
        place = {key: row[f"videos/{feature}/{key}"] for key in ("chunk_index", "file_index")}
        path = self.root / self.info["video_path"].format(video_key=feature, **place)
        with _reading(path):
            frames = decode_video(path.read_bytes())
        begin = round(row[f"videos/{feature}/from_timestamp"] * self.fps)
        return frames[begin : begin + row["length"]]

    def units(self, feature: str) -> tuple[str, ...]:
        """Units of a feature's components; empty texts where the dataset does not say."""
        size = self.features[feature]["shape"][0]
        return tuple(self.manifest.get("units", {}).get(feature, [""] * size))

    def names(self, feature: str) -> tuple[str, ...]:
        """Names of a feature's components; numbers where the dataset does not say."""
        told = self.features[feature]
        names = told.get("names")
        if isinstance(names, dict):
            names = [name for group in names.values() for name in group]
        return tuple(names) if names else tuple(str(i) for i in range(told["shape"][0]))

    def _rows_of(self, row: dict[str, Any]) -> pa.Table:
        """The rows of an episode; the file that they are in stays open for the next one."""
        place = row["data/chunk_index"], row["data/file_index"]
        path = self.root / self.info["data_path"].format(chunk_index=place[0], file_index=place[1])
        with _reading(path):
            if self._open is None or self._open[0] != path:
                self._open = path, _Rows(path, self._first_row[place])
            table = self._open[1].read(row["dataset_from_index"], row["dataset_to_index"])
        if len(table) != row["length"]:
            raise DatasetError(f"{path} ends before the last row of episode {row['episode_index']}; convert again")
        return table

    @cached_property
    def _first_row(self) -> dict[tuple[int, int], int]:
        """Chunk and file to the number of its first row."""
        first: dict[tuple[int, int], int] = {}
        for row in self.episodes:
            place = row["data/chunk_index"], row["data/file_index"]
            first[place] = min(row["dataset_from_index"], first.get(place, row["dataset_from_index"]))
        return first


class _Rows:
    """The rows of a Parquet file, of which only the row groups that are asked for are read."""

    def __init__(self, path: Path, first: int):
        self._file = pq.ParquetFile(path)
        about = self._file.metadata
        sizes = [about.row_group(i).num_rows for i in range(about.num_row_groups)]
        self._ends = first + np.cumsum(sizes, dtype=int)
        self._begins = self._ends - sizes
        self._last: tuple[tuple[int, ...], pa.Table] | None = None

    def read(self, begin: int, end: int) -> pa.Table:
        """The rows from number `begin` to `end` of the dataset."""
        groups = tuple(np.flatnonzero((self._begins < end) & (self._ends > begin)).tolist())
        if self._last is None or self._last[0] != groups:
            self._last = groups, self._file.read_row_groups(list(groups), use_threads=False)
        offset = begin - int(self._begins[groups[0]]) if groups else 0
        return self._last[1].slice(offset, end - begin)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn what a damaged file raises into a sentence."""
    try:
        yield
    except UNREADABLE as error:
        raise DatasetError(f"{path} cannot be read ({error}); convert the recordings again") from error


def _rows(column: pa.ChunkedArray) -> np.ndarray:
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):  # no rows
        array = pa.array([], column.type)
    if pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type):
        flat = array.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(len(array), -1)
    return array.to_numpy(zero_copy_only=False).reshape(-1, 1)
