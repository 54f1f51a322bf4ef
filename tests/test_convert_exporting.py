"""The way back, and that other programs open what is written."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.exporting import export
from lfd.convert.hdf5.demo_file import read_demo, read_file
from lfd.convert.sources import SourceRecipe, episode_in, units_of
from lfd.convert.to_lerobot import convert
from lfd.core.errors import InputError, OutputError
from lfd.record.episode_file import read_episode
from lfd.record.episode_writing import write_episode
from lfd.record.png import decode_png
from lfd.trace import trace
from tests.hdf5_files import LIFT
from tests.small_recordings import CAMERA, FEATURE, filmed, part, recipe, write_all


@pytest.fixture(scope="module")
def recordings(recorded, tmp_path_factory) -> Path:
    folder, episode = tmp_path_factory.mktemp("recordings"), filmed(recorded)
    write_all(folder, part(episode, 0, 15), part(episode, 10, 40))
    return folder


@pytest.fixture(scope="module", params=["png", "h264"])
def dataset(request, recordings, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / request.param
    convert([recordings], out, recipe=recipe(video={"codec": request.param}, cameras=[CAMERA]))
    return out


@pytest.fixture(scope="module")
def exported(dataset, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("exported") / dataset.name
    assert export([dataset], out, to="mcap").episodes == 2
    return out


def test_the_recipe_beside_the_files_makes_the_same_numbers_of_them(dataset, exported, tmp_path) -> None:
    assert sorted(path.name for path in exported.iterdir()) == [
        "episode_000000.mcap",
        "episode_000001.mcap",
        "manifest.json",
        "recipe.toml",
    ]
    back = tmp_path / "back"
    wanted = SourceRecipe.load(exported / "recipe.toml")
    wanted = replace(wanted, tables={**wanted.tables, "video": {"codec": "png"}})
    convert([exported], back, recipe=wanted)
    one, other = DatasetFiles(dataset), DatasetFiles(back)
    assert (len(one), one.fps, one.tasks) == (len(other), other.fps, other.tasks)
    assert one.info["robot_type"] == other.info["robot_type"]
    for index in range(len(one)):
        a, b = one.read(index), other.read(index)
        assert a.tasks == b.tasks
        for name, rows in a.columns.items():
            np.testing.assert_array_equal(rows.astype(np.float64), b.columns[name].astype(np.float64), err_msg=name)
        is_video = dataset.name != "png"
        pictures = one.video(index, FEATURE) if is_video else [decode_png(data) for data in a.pngs[FEATURE]]
        np.testing.assert_array_equal(pictures, [decode_png(data) for data in b.pngs[FEATURE]])
    names = other.names("observation.state")
    assert names[:2] == ("observation.state.joint_pos.robot0_joint1", "observation.state.joint_pos.robot0_joint2")


def test_a_standard_ros2_reader_understands_the_files(dataset, exported) -> None:
    files = DatasetFiles(dataset)
    for index in range(2):
        stored, topics = files.read(index), dict[str, list[Any]]()
        with (exported / f"episode_{index:06d}.mcap").open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for schema, channel, message, decoded in reader.iter_decoded_messages():
                assert schema is not None
                topics.setdefault(channel.topic, []).append((message.log_time, decoded, channel.metadata))
            (about,) = (record.metadata for record in reader.iter_metadata())
        assert about == {
            "dataset": dataset.name,
            "episode": str(index),
            "fps": "20",
            "tasks": json.dumps(list(stored.tasks)),
        }
        state = topics["/observation/state"]
        seen = np.array([message.data for _, message, _ in state])
        np.testing.assert_array_equal(seen, stored.columns["observation.state"].astype(np.float64))
        assert state[0][1].layout.dim[0].label == ",".join(files.names("observation.state"))
        assert state[0][2] == {"feature": "observation.state", "units": ",".join(files.units("observation.state"))}
        np.testing.assert_array_equal(np.diff([time for time, _, _ in state]), 50_000_000)
        assert topics["/task"][0][1].data == stored.tasks[0]
        picture = topics["/observation/images/agentview"][3][1]
        assert picture.format == "png"
        assert decode_png(bytes(picture.data)).shape == (64, 96, 3)


@pytest.mark.slow
def test_rerun_s_own_loader_shows_the_files(dataset, exported, tmp_path) -> None:
    from tests.test_replay import columns

    rrd = tmp_path / "episode.rrd"
    command = [Path(sys.executable).parent / "rerun", "mcap", "convert", exported / "episode_000000.mcap", "-o", rrd]
    subprocess.run(command, check=True, capture_output=True)
    held = columns(rrd)
    stored = DatasetFiles(dataset).read(0)
    for feature in ("observation.state", "action", "next.reward"):
        shown = [
            (time, values)
            for batch in held["/" + feature.replace(".", "/")]
            if "Scalars:scalars" in batch.schema.names
            for time, values in zip(
                batch["message_log_time"].to_pylist(), batch["Scalars:scalars"].to_pylist(), strict=True
            )
            if values
        ]
        rows = [values for _, values in sorted(shown, key=lambda row: row[0])]
        np.testing.assert_array_equal(rows, stored.columns[feature])
    pictures = [batch for batch in held["/observation/images/agentview"] if "EncodedImage:blob" in batch.schema.names]
    assert sum(batch.num_rows for batch in pictures) == 15


def test_an_export_says_what_it_was_made_of(dataset, exported) -> None:
    (parent,) = trace(exported).parents
    assert (parent.path, parent.kind, parent.state) == (str(dataset), "dataset", "intact")
    assert len(parent.parents) == 2


def test_demonstrations_in_hdf5_become_recordings(tmp_path) -> None:
    out = tmp_path / "out"
    units = units_of([LIFT], SourceRecipe(where="test"))
    assert export([LIFT], out, to="mcap").episodes == len(units)
    for index, unit in enumerate(units):
        expected = episode_in(unit, SourceRecipe(where="test"))
        same_episode(read_episode(out / f"episode_{index:06d}.mcap"), expected)
    parents = trace(out).parents
    assert [(parent.path, parent.state) for parent in parents] == [(str(LIFT), "intact")]


def same_episode(read: Any, expected: Any) -> None:
    np.testing.assert_allclose(read.times, expected.times, rtol=0, atol=1e-9)
    assert set(read.observations) == set(expected.observations)
    for name, values in expected.observations.items():
        np.testing.assert_array_equal(read.observations[name], values, err_msg=name)
    for name in ("actions", "rewards", "successes", "interventions", "expert_actions", "sim_states"):
        np.testing.assert_array_equal(getattr(read, name), getattr(expected, name), err_msg=name)
    assert dict(read.pictures) == dict(expected.pictures)
    assert read.labels == expected.labels
    assert read.metadata == expected.metadata
    assert read.model_xml == expected.model_xml
    assert read.success == expected.success


def test_an_episode_is_written_and_read_to_the_bit(recorded, tmp_path) -> None:
    whole = replace(filmed(recorded), expert_actions=recorded.actions + 0.125)
    for number, episode in enumerate((recorded, whole, part(recorded, 3, 4))):
        write_episode(tmp_path / f"{number}.mcap", episode)
        same_episode(read_episode(tmp_path / f"{number}.mcap"), episode)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.mcap", "1.mcap", "2.mcap"]


def test_a_dataset_becomes_a_file_for_robomimic(dataset, tmp_path) -> None:
    out = tmp_path / "demos.hdf5"
    assert export([dataset], out, to="robomimic", seed=1).episodes == 2
    file, files = read_file(out), DatasetFiles(dataset)
    for index, name in enumerate(file.demos):
        np.testing.assert_array_equal(read_demo(file, name).actions, files.read(index).columns["action"])


def test_what_cannot_be_exported(dataset, recordings, tmp_path, lfd_fails) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="cannot export to 'zarr'; choose mcap or robomimic"):
        export([dataset], out, to="zarr")
    assert "is a dataset: export one at a time" in lfd_fails(
        "export", dataset, recordings, "--to", "mcap", "--out", out
    )
    error = lfd_fails("export", recordings, "--to", "mcap", "--out", out)
    assert "recordings are MCAP files already; export them with --to robomimic" in error
    error = lfd_fails("export", "tests/data/rosbag2parquet_base_msgs.mcap", "--to", "robomimic", "--out", out)
    assert "is an MCAP file, but no episode of lfd" in error
    assert "no recording" in lfd_fails("export", tmp_path / "none", "--to", "mcap", "--out", out)
    out.mkdir()
    (out / "mine").touch()
    with pytest.raises(OutputError, match="exists already; choose another --out, or add --overwrite"):
        export([dataset], out, to="mcap")
    with pytest.raises(OutputError, match="holds files that lfd did not make"):
        export([dataset], out, to="mcap", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
