"""Writes the files of a LeRobot v3 dataset: rows and episodes as Parquet, pictures or videos, statistics.

LeRobot's own writer takes frames one by one and passes each episode through Hugging Face's `datasets`; here an episode
is one row group, written from arrays. What lies in memory does not grow with the number of episodes.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lfd.convert.dataset.statistics import Stats, aggregate, column_stats
from lfd.convert.prepared import PreparedEpisode
from lfd.core.artifact import write_json
from lfd.core.errors import DatasetError

VERSION = "v3.0"
FILE_BYTES = 100 * 2**20
"""Size at which a file of rows is closed and the next one begun."""
FILE_EPISODES = 250
"""Episodes after which it is closed too: what Parquet keeps of each row group stays in memory until then."""
FILES_PER_CHUNK = 1000
BATCH = 100
"""Episodes whose descriptions are written at once."""
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA, EPISODES, VIDEOS = (
    f"data/{PLACE}.parquet",
    f"meta/episodes/{PLACE}.parquet",
    "videos/{video_key}/" + PLACE + ".mp4",
)
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
OWN: dict[str, str] = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Features that every LeRobot dataset has."""
ARROW = {"float32": pa.float32(), "bool": pa.bool_(), "int64": pa.int64()}


@contextmanager
def dataset_writer(root: Path) -> Iterator["DatasetWriter"]:
    """A writer for a new dataset in the folder `root`, or for further episodes of the one that is there."""
    writer = DatasetWriter(root)
    try:
        yield writer
        writer.finish()
    finally:
        writer.close()


class DatasetWriter:
    """Appends episodes; the dataset is whole after `finish`.

    Raises `DatasetError` for an episode that does not go with those before it.
    """

    def __init__(self, root: Path):
        self._root = root
        self.episodes = self.frames = 0
        self._tasks: dict[str, int] = {}
        self._stats: list[Mapping[str, Stats]] = []
        self._info: dict[str, Any] = {}
        self._rows: _Parquet | None = None
        self._described: list[dict[str, Any]] = []
        self._first: str = ""
        if (root / INFO).is_file():
            self._open()
        self._data_file = _next_place(root / "data")
        self._episodes_file = _next_place(root / "meta" / "episodes")
        self._table: _Parquet | None = None

    def _open(self) -> None:
        """Go on with a dataset that is there."""
        self._info = json.loads((self._root / INFO).read_text(encoding="utf-8"))
        self.episodes, self.frames = self._info["total_episodes"], self._info["total_frames"]
        tasks = pq.read_table(self._root / TASKS).to_pydict()
        self._tasks = dict(zip(tasks["task"], tasks["task_index"], strict=True))
        stats = json.loads((self._root / STATS).read_text(encoding="utf-8"))
        self._stats = [{name: {key: np.array(v) for key, v in row.items()} for name, row in stats.items()}]
        self._first = str(self._root)

    def add(self, episode: PreparedEpisode) -> None:
        """Append an episode."""
        self.check_fits(episode)
        length, index = len(episode), self.episodes
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        own = {
            "timestamp": np.arange(length, dtype=np.float32)[:, None] / np.float32(episode.fps),
            "frame_index": np.arange(length)[:, None],
            "episode_index": np.full((length, 1), index),
            "index": np.arange(self.frames, self.frames + length)[:, None],
            "task_index": np.full((length, 1), task),
        }
        if self._rows is None or self._rows.size >= FILE_BYTES or self._rows.count >= FILE_EPISODES:
            self._next_file()
        assert self._rows is not None
        self._rows.write(pa.table(self._arrays(episode, own), schema=self._rows.schema))
        row: dict[str, Any] = {
            "episode_index": index,
            "tasks": [episode.task],
            "length": length,
            "data/chunk_index": self._data_file[0],
            "data/file_index": self._data_file[1],
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + length,
        }
        for name, video in episode.videos.items():
            row |= self._write_video(name, video, length / episode.fps)
        stats = {**episode.stats, **column_stats(own)}
        row |= {f"stats/{name}/{key}": v.tolist() for name, part in stats.items() for key, v in part.items()}
        self._described.append(row)
        self._stats.append(stats)
        self.episodes, self.frames = self.episodes + 1, self.frames + length
        if len(self._described) >= BATCH:
            self._describe()

    def finish(self) -> None:
        """Write what describes the whole dataset."""
        if not self._info:
            raise DatasetError("no episode was left to make a dataset of")
        self._describe()
        self.close()
        tasks = pa.table({"task_index": list(self._tasks.values()), "task": list(self._tasks)})
        _replace(self._root / TASKS, lambda path: pq.write_table(_indexed_by_task(tasks), path))
        (stats,) = self._stats
        write_json(self._root / STATS, {n: {k: v.tolist() for k, v in part.items()} for n, part in stats.items()})
        self._info |= {
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "splits": {"train": f"0:{self.episodes}"},
        }
        write_json(self._root / INFO, self._info)

    def close(self) -> None:
        """Close the open files."""
        for table in (self._rows, self._table):
            if table is not None:
                table.close()
        self._rows = self._table = None

    def check_fits(self, episode: PreparedEpisode) -> None:
        """Describe the dataset by its first episode, and compare the others with it; raises `DatasetError`."""
        features = {name: {**told, "shape": list(told["shape"])} for name, told in episode.features.items()}
        features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in OWN.items()}
        told = {"fps": episode.fps, "features": features, "robot_type": episode.about.get("robot")}
        if not self._info:
            self._info, self._first = _info_of(**told), episode.source
            return
        for key, value in told.items():
            there = self._info[key]
            if key == "features" and value != there:
                name = next(n for n in (*value, *there) if value.get(n) != there.get(n))
                value, there, key = value.get(name), there.get(name), f"feature {name}"
            if value != there:
                raise DatasetError(
                    f"{episode.source} does not go with {self._first}: {key} is {_short(value)} here and "
                    f"{_short(there)} there; make datasets of their own"
                )

    def _arrays(self, episode: PreparedEpisode, own: Mapping[str, np.ndarray]) -> dict[str, pa.Array]:
        made = {name: _array(rows) for name, rows in (*episode.columns.items(), *own.items())}
        for name, pictures in episode.pngs.items():
            paths = [f"frame-{row:06d}.png" for row in range(len(pictures))]
            made[name] = pa.StructArray.from_arrays([pa.array(pictures), pa.array(paths)], ["bytes", "path"])
        return made

    def _next_file(self) -> None:
        if self._rows is not None:
            self._rows.close()
            self._data_file = _after(self._data_file)
        path = self._root / DATA.format(chunk_index=self._data_file[0], file_index=self._data_file[1])
        self._rows = _Parquet(path, _data_schema(self._info["features"]))

    def _write_video(self, name: str, content: bytes, seconds: float) -> dict[str, Any]:
        chunk, file = divmod(self.episodes, FILES_PER_CHUNK)  # a file for each episode
        path = self._root / VIDEOS.format(video_key=name, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        place = {"chunk_index": chunk, "file_index": file, "from_timestamp": 0.0, "to_timestamp": seconds}
        return {f"videos/{name}/{key}": value for key, value in place.items()}

    def _describe(self) -> None:
        """Write the descriptions of the episodes that wait, and sum up their statistics."""
        if not self._described:
            return
        for row in self._described:
            row |= {
                "meta/episodes/chunk_index": self._episodes_file[0],
                "meta/episodes/file_index": self._episodes_file[1],
            }
        if self._table is None:
            path = EPISODES.format(chunk_index=self._episodes_file[0], file_index=self._episodes_file[1])
            self._table = _Parquet(self._root / path, _episodes_schema(self._described[0]))
        self._table.write(pa.Table.from_pylist(self._described, schema=self._table.schema))
        self._described.clear()
        self._stats = [aggregate(self._stats)]


class _Parquet:
    """A Parquet file that is being written, one row group a call."""

    def __init__(self, path: Path, schema: pa.Schema):
        path.parent.mkdir(parents=True, exist_ok=True)
        self.schema = schema
        self._stream = path.open("wb")
        self._writer = pq.ParquetWriter(self._stream, schema, compression="snappy")
        self.count = 0
        """Row groups so far."""

    @property
    def size(self) -> int:
        return self._stream.tell()

    def write(self, table: pa.Table) -> None:
        self._writer.write_table(table)
        self.count += 1

    def close(self) -> None:
        try:
            self._writer.close()
        finally:
            self._stream.close()


def _array(rows: np.ndarray) -> pa.Array:
    flat = pa.array(rows.reshape(-1))
    return flat if rows.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, rows.shape[1])


def _data_schema(features: Mapping[str, Any]) -> pa.Schema:
    """Types of the columns, with the description that Hugging Face's `datasets` keeps beside them."""
    columns, described = {}, {}
    for name, told in features.items():
        if told["dtype"] == "video":
            continue
        if told["dtype"] == "image":
            columns[name] = pa.struct({"bytes": pa.binary(), "path": pa.string()})
            described[name] = {"_type": "Image"}
            continue
        value = {"dtype": told["dtype"], "_type": "Value"}
        (size,) = told["shape"]
        columns[name] = ARROW[told["dtype"]] if size == 1 else pa.list_(ARROW[told["dtype"]], size)
        described[name] = value if size == 1 else {"feature": value, "length": size, "_type": "List"}
    return pa.schema(columns, metadata={"huggingface": json.dumps({"info": {"features": described}})})


def _episodes_schema(row: Mapping[str, Any]) -> pa.Schema:
    def kind(key: str, value: Any) -> pa.DataType:
        if isinstance(value, list):
            return pa.list_(kind(key, value[0]))
        if isinstance(value, str):
            return pa.string()
        is_real = isinstance(value, float) or (key.startswith("stats/") and not key.endswith("/count"))
        return pa.float64() if is_real else pa.int64()

    return pa.schema({key: kind(key, value) for key, value in row.items()})


def _indexed_by_task(table: pa.Table) -> pa.Table:
    """With the note by which pandas, and so LeRobot, takes the task for the index of the table."""
    names = ("task_index", "task")
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": n, "field_name": n, "pandas_type": kinds[n][0], "numpy_type": kinds[n][1], "metadata": None}
        for n in names
    ]
    note = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    return table.replace_schema_metadata({"pandas": json.dumps(note)})


def _info_of(fps: int, features: Mapping[str, Any], robot_type: str | None) -> dict[str, Any]:
    has_videos = any(told["dtype"] == "video" for told in features.values())
    return {
        "codebase_version": VERSION,
        "fps": fps,
        "features": features,
        "total_episodes": 0,
        "total_frames": 0,
        "total_tasks": 0,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": FILE_BYTES // 2**20,
        "video_files_size_in_mb": 200,
        "data_path": DATA,
        "video_path": VIDEOS if has_videos else None,
        "robot_type": robot_type,
        "splits": {},
    }


def _next_place(folder: Path) -> tuple[int, int]:
    """Chunk and number of the first file that is not there."""
    files = [(int(p.parent.name[6:]), int(p.stem[5:])) for p in folder.glob("chunk-*/file-*.parquet")]
    return _after(max(files)) if files else (0, 0)


def _after(place: tuple[int, int]) -> tuple[int, int]:
    chunk, file = place
    return (chunk, file + 1) if file + 1 < FILES_PER_CHUNK else (chunk + 1, 0)


def _replace(path: Path, write: Any) -> None:
    """Write a file anew: another dataset may share the old one by a hard link."""
    part = path.with_name(path.name + ".part")
    write(part)
    part.replace(path)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 300 else f"{text[:300]}…"
