import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from lfd.core.errors import DatasetError
from lfd.data.frames import load_frames


@pytest.fixture
def copy(thread, tmp_path) -> Path:
    return Path(shutil.copytree(thread.dataset, tmp_path / "dataset"))


def test_frames_equal_lerobots_to_the_bit(thread) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset: Any = LeRobotDataset("lfd/test", root=thread.dataset, video_backend="pyav")
    frames = load_frames(thread.dataset)
    assert len(frames) == len(dataset)
    for index in (0, 1, len(dataset) // 2, len(dataset) - 1):
        row = dataset[index]
        assert int(row["episode_index"]) == int(frames.episode_index[index])
        for feature, values in frames.columns.items():
            assert torch.equal(row[feature], values[index]), feature
    for feature in frames.columns:
        np.testing.assert_array_equal(frames.stats[feature]["mean"], dataset.meta.stats[feature]["mean"].astype("f4"))


def test_not_a_number_is_refused_with_its_place(copy) -> None:
    file = next((copy / "data").rglob("*.parquet"))
    table = pq.read_table(file)
    actions = table["action"].to_pylist()
    actions[4][0] = float("nan")
    at = table.schema.get_field_index("action")
    pq.write_table(table.set_column(at, "action", pa.array(actions, table.schema.field("action").type)), file)
    with pytest.raises(DatasetError, match=r"action is not finite in row 4 \(episode 0\)"):
        load_frames(copy)


def test_missing_rows_are_noticed(copy) -> None:
    file = next((copy / "data").rglob("*.parquet"))
    table = pq.read_table(file)
    pq.write_table(table.slice(1), file)
    with pytest.raises(DatasetError, match=rf"data has {len(table) - 1} frames, meta/info.json says {len(table)}"):
        load_frames(copy)


def test_a_missing_statistic_raises(copy) -> None:
    path = copy / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    del stats["action"]["std"]
    path.write_text(json.dumps(stats))
    with pytest.raises(DatasetError, match="stats.json lacks the statistics of action"):
        load_frames(copy)


def test_folders_that_are_no_dataset(copy, tmp_path) -> None:
    with pytest.raises(DatasetError, match="is no LeRobot dataset: it has no meta/info.json"):
        load_frames(tmp_path / "nothing")
    file = next((copy / "data").rglob("*.parquet"))
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(DatasetError, match="data cannot be read"):
        load_frames(copy)
    info = copy / "meta" / "info.json"
    info.write_text(info.read_text().replace('"v3.0"', '"v2.1"'))
    with pytest.raises(DatasetError, match=r"version v2.1, expected v3.0"):
        load_frames(copy)


def test_units_and_interventions_of_our_converter(thread) -> None:
    frames = load_frames(thread.dataset)
    assert frames.units.keys() == frames.names.keys() == frames.columns.keys()
    assert frames.units["observation.state"][:1] == ("rad",)
    assert frames.intervention is not None
    assert frames.intervention.shape == (len(frames),)
    assert not frames.intervention.any()
    first, end = frames.episodes
    assert first.tolist() == [0, int(end[0])]
    assert int(end[1]) == len(frames)


def test_a_vector_of_two_axes_is_refused(copy) -> None:
    info = copy / "meta" / "info.json"
    told = json.loads(info.read_text())
    told["features"]["action"]["shape"] = [7, 1]
    info.write_text(json.dumps(told))
    with pytest.raises(DatasetError, match=r"action has the shape \(7, 1\), expected one vector for each frame"):
        load_frames(copy)


def test_episodes_in_disorder_are_refused(copy) -> None:
    file = next((copy / "data").rglob("*.parquet"))
    table = pq.read_table(file)
    pq.write_table(table.take(list(range(len(table)))[::-1]), file)
    with pytest.raises(DatasetError, match="does not have its episodes one after the other"):
        load_frames(copy)
