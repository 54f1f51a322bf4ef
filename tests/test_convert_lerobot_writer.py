"""The files of a dataset: compared with those of LeRobot's own writer, and cut into files and chunks."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from lfd.convert.dataset import lerobot_writer
from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.dataset.lerobot_writer import BATCH, dataset_writer
from lfd.convert.dataset.statistics import QUANTILES, column_stats
from lfd.convert.dataset.video import VideoRecipe
from lfd.convert.frames import EpisodeFrames
from lfd.convert.prepared import PreparedEpisode, prepare
from lfd.convert.sources import frames_of, units_of
from lfd.core.errors import DatasetError
from tests.small_recordings import FEATURE, filmed, part, recipe, write_all

NO_VIDEO = VideoRecipe(codec="png")


def made_up(rng: np.random.Generator, rows: int, task: str = "wave", fps: int = 10, size: int = 3) -> EpisodeFrames:
    """Random rows."""
    names = tuple(f"a.{i}" for i in range(size))
    return EpisodeFrames(
        source=f"episode of {rows} rows",
        fps=fps,
        task=task,
        columns={
            "observation.state": rng.normal(size=(rows, size)).astype(np.float32),
            "action": rng.normal(size=(rows, 1)).astype(np.float32),
            "next.done": rng.random((rows, 1)) < 0.5,
        },
        names={"observation.state": names, "action": ("x",), "next.done": ("done",)},
        units={"observation.state": ("m",) * size, "action": ("1",), "next.done": ("1",)},
        about={"robot": "arm"},
    )


def write(root: Path, episodes: list[EpisodeFrames]) -> list[PreparedEpisode]:
    prepared = [prepare(frames, NO_VIDEO) for frames in episodes]
    with dataset_writer(root) as writer:
        for episode in prepared:
            writer.add(episode)
    return prepared


def check_rows(root: Path, episodes: list[EpisodeFrames]) -> None:
    files, at = DatasetFiles(root), 0
    assert len(files) == len(episodes)
    for index, frames in enumerate(episodes):
        stored, row = files.read(index), files.episodes[index]
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (at, at + len(frames))
        for name, rows in frames.columns.items():
            assert stored.columns[name].dtype == rows.dtype
            np.testing.assert_array_equal(stored.columns[name], rows)
        np.testing.assert_array_equal(stored.columns["index"][:, 0], np.arange(at, at + len(frames)))
        np.testing.assert_array_equal(stored.columns["frame_index"][:, 0], np.arange(len(frames)))
        assert (stored.columns["episode_index"] == index).all()
        assert {files.tasks[t] for t in stored.columns["task_index"][:, 0]} == {frames.task}
        at += len(frames)


def test_files_are_closed_at_their_size_and_numbered_on_into_the_next_chunk(rng, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(lerobot_writer, "FILE_BYTES", 4000)
    monkeypatch.setattr(lerobot_writer, "FILES_PER_CHUNK", 3)
    episodes = [made_up(rng, rows) for rows in rng.integers(2, 60, 40)]
    write(tmp_path, episodes)
    places = sorted(path.relative_to(tmp_path / "data").as_posix() for path in (tmp_path / "data").rglob("*.parquet"))
    expected = [f"chunk-{i // 3:03d}/file-{i % 3:03d}.parquet" for i in range(len(places))]
    assert len(places) > 7
    assert places == expected
    check_rows(tmp_path, episodes)
    for path in (tmp_path / "data").rglob("*.parquet"):
        sizes = [
            pq.ParquetFile(path).metadata.row_group(i).num_rows for i in range(pq.ParquetFile(path).num_row_groups)
        ]
        at = pq.read_table(path)["episode_index"][0].as_py()
        assert sizes == [len(frames) for frames in episodes[at : at + len(sizes)]]  # an episode is a row group


@pytest.mark.parametrize("count", [1, BATCH - 1, BATCH, BATCH + 1, 2 * BATCH])
def test_many_episodes_are_described_in_batches_and_summed_up(count, rng, tmp_path) -> None:
    episodes = [made_up(rng, int(rows), task=f"task {rows % 3}") for rows in rng.integers(1, 9, count)]
    write(tmp_path, episodes)
    check_rows(tmp_path, episodes)
    described = pq.ParquetFile(tmp_path / "meta/episodes/chunk-000/file-000.parquet")
    assert described.num_row_groups == -(-count // BATCH)
    stats = json.loads((tmp_path / "meta/stats.json").read_text())
    together = column_stats({"action": np.concatenate([frames.columns["action"] for frames in episodes])})["action"]
    for key in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(stats["action"][key], together[key], rtol=1e-9, err_msg=key)
    info = json.loads((tmp_path / "meta/info.json").read_text())
    assert (info["total_episodes"], info["total_frames"]) == (count, sum(map(len, episodes)))
    assert info["total_tasks"] == len({frames.task for frames in episodes}) == len(DatasetFiles(tmp_path).tasks)
    assert info["splits"] == {"train": f"0:{count}"}


def test_episodes_that_do_not_fit_are_refused_by_name_and_difference(rng, tmp_path) -> None:
    first = prepare(made_up(rng, 4), NO_VIDEO)
    for other, said in (
        (made_up(rng, 3, fps=20), "fps is 20 here and 10 there"),
        (made_up(rng, 3, size=2), "feature observation.state is .*'shape': .2.* here and .*'shape': .3.* there"),
    ):
        with dataset_writer(tmp_path / said[:3]) as writer:
            writer.add(first)
            with pytest.raises(DatasetError, match=f"episode of 3 rows does not go with episode of 4 rows: {said}"):
                writer.add(prepare(other, NO_VIDEO))
    with pytest.raises(DatasetError, match="no episode was left to make a dataset of"), dataset_writer(tmp_path / "no"):
        pass


@pytest.mark.slow
def test_lerobot_s_own_writer_leaves_the_same_files(recorded, tmp_path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    episode = filmed(recorded)
    write_all(tmp_path / "recordings", part(episode, 0, 20), part(episode, 20, 35, instruction="another task"))
    wanted = recipe(video={"codec": "png"}, cameras=["agentview"])
    units = units_of([tmp_path / "recordings"], wanted)
    episodes = [frames for unit in units for frames in frames_of(unit, wanted)]
    prepared = write(tmp_path / "ours", episodes)
    theirs = LeRobotDataset.create(
        "lfd/theirs", 20, dict(prepared[0].features), root=tmp_path / "theirs", robot_type="panda", use_videos=False
    )
    for frames in episodes:
        for t in range(len(frames)):
            rows = {name: values[t] for name, values in frames.columns.items()}
            theirs.add_frame({**rows, FEATURE: frames.pictures[FEATURE][t], "task": frames.task})
        theirs.save_episode()
    theirs.finalize()
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    assert files_in(ours) == files_in(theirs)

    assert json.loads((ours / "meta/info.json").read_text()) == json.loads((theirs / "meta/info.json").read_text())
    for name in ("data", "meta/episodes"):
        a, b = (pq.read_table(root / name / "chunk-000/file-000.parquet") for root in (ours, theirs))
        assert {f.name: f.type for f in a.schema} == {f.name: f.type for f in b.schema}
        if name == "data":
            told, expected = (json.loads(table.schema.metadata[b"huggingface"])["info"] for table in (a, b))
            assert told == expected
        for column in a.schema.names:
            if column.startswith("stats/"):
                compare_stats(a[column].to_pylist(), b[column].to_pylist(), column.rpartition("/")[2])
            elif column != FEATURE:
                assert a[column].to_pylist() == b[column].to_pylist(), column
    tasks = [pq.read_table(root / "meta/tasks.parquet").to_pandas() for root in (ours, theirs)]
    assert tasks[0].equals(tasks[1])
    stats = [json.loads((root / "meta/stats.json").read_text()) for root in (ours, theirs)]
    assert set(stats[0]) == set(stats[1])
    for feature, found in stats[0].items():
        assert set(found) == set(stats[1][feature])
        for key, value in found.items():
            compare_stats([value], [stats[1][feature][key]], key)

    opened: list[Any] = [LeRobotDataset("lfd/x", root=root, video_backend="pyav") for root in (ours, theirs)]
    a, b = opened
    assert a.hf_dataset.features == b.hf_dataset.features
    assert a.features == b.features
    for i in (0, 19, 20, 34):
        one, other = a[i], b[i]
        assert set(one) == set(other)
        assert all((one[key] == other[key]).all() if key != "task" else one[key] == other[key] for key in one)
    doctor(ours)


def compare_stats(ours: list[Any], theirs: list[Any], key: str) -> None:
    """The same but for its sums in float32; quantiles of so few rows, which it interpolates, look alike."""
    for a, b in zip(ours, theirs, strict=True):
        assert np.shape(a) == np.shape(b)
        if key not in QUANTILES:
            np.testing.assert_allclose(a, b, rtol=2e-2 if np.ndim(a) > 1 else 1e-3, atol=1e-4, err_msg=key)


def files_in(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())


def doctor(root: Path) -> None:
    """The judgement of another program, which exits with 1 for a fault."""
    command = [Path(sys.executable).parent / "lerobot-doctor", "check", root, "--ci", "--fail-on", "fail"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert json.loads(done.stdout)["summary"]["FAIL"] == 0
