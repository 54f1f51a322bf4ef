import os
import subprocess
import sys
from ctypes.util import find_library
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfd.core.errors import LfdError, OutputError, UnknownName
from lfd.core.recipe import build, load_toml
from lfd.record.demonstrations import RecordRecipe, record
from lfd.record.episode_file import read_episode, recordings_in
from lfd.worlds import robosuite_world

RECIPE = Path("datasets/lift_panda.toml")


@pytest.fixture
def short() -> RecordRecipe:
    """So little time that some attempts fail."""
    recipe = build(RecordRecipe, load_toml(RECIPE, ["record", "convert"])["record"], "recipe")
    return replace(recipe, episodes=3, max_seconds=1.9, attempts_per_episode=20)


def test_what_is_recorded_does_not_depend_on_the_number_of_worlds(short, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(robosuite_world, "cores", lambda: 3)
    recorded = []
    for most in (1, 3):
        out = tmp_path / str(most)
        done = record(short, out, tables={}, most_worlds=most)
        assert done.episodes == 3
        assert done.failures > 0  # else the numbers of the attempts say nothing
        recorded.append({path.name: read_episode(path) for path in recordings_in([out])})
    alone, together = recorded
    assert list(alone) == list(together)
    for name, episode in alone.items():
        np.testing.assert_array_equal(episode.sim_states, together[name].sim_states)
        np.testing.assert_array_equal(episode.actions, together[name].actions)


def test_too_many_failures_end_the_recording_and_keep_the_successes(short, tmp_path) -> None:
    hopeless = replace(short, max_seconds=0.5, attempts_per_episode=2)
    with pytest.raises(LfdError, match="6 of 6 attempts failed; 0 demonstrations are in"):
        record(hopeless, tmp_path / "out", tables={})


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> Path:
    """One demonstration with two cameras, and the dataset made of it."""
    if not (find_library("EGL") or find_library("OSMesa") or "CI" in os.environ):
        pytest.skip("offscreen rendering needs a library that `make system` installs")
    from lfd.convert.to_lerobot import convert

    folder = tmp_path_factory.mktemp("filmed")
    tables = load_toml(RECIPE, ["record", "convert"])
    cameras = ["agentview", "robot0_eye_in_hand"]
    tables["record"] |= {"episodes": 1, "cameras": cameras, "camera_height": 48, "camera_width": 64}
    tables["convert"]["cameras"] = cameras
    tables["video"] = {"codec": "png"}
    record(build(RecordRecipe, tables["record"], "recipe"), folder / "recordings", tables=tables)
    convert([folder / "recordings"], folder / "dataset")  # verifies every pixel
    return folder


def test_pictures_show_the_recorded_states(filmed) -> None:
    from lfd.record.png import decode_png
    from lfd.worlds.cameras import Cameras

    episode = read_episode(filmed / "recordings" / "episode_000000.mcap")
    assert episode.sim_states is not None
    assert list(episode.pictures) == ["agentview", "robot0_eye_in_hand"]
    cameras = Cameras(episode.model_xml, list(episode.pictures), height=48, width=64)
    for t in (0, len(episode) // 2, len(episode)):
        for name, picture in cameras.render(episode.sim_states[t]).items():
            np.testing.assert_array_equal(decode_png(episode.pictures[name][t]), picture)
    cameras.close()


def test_pictures_are_in_the_dataset_and_in_the_replay(filmed, tmp_path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lfd.record.png import decode_png
    from lfd.replay.clip import clip_of
    from lfd.replay.rerun_scene import replay

    episode = read_episode(filmed / "recordings" / "episode_000000.mcap")
    dataset: Any = LeRobotDataset("lfd/filmed", root=filmed / "dataset", video_backend="pyav")
    row = dataset[7]
    seen = (row["observation.images.agentview"].numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8)
    np.testing.assert_array_equal(seen, decode_png(episode.pictures["agentview"][7]))
    pictures = sum(len(data) for one in episode.pictures.values() for data in one)
    for what in ("recordings", "dataset"):
        clip = clip_of(filmed / what, 0)
        replay(clip, save=tmp_path / f"{what}.rrd")
        replay(replace(clip, pictures={}), save=tmp_path / f"{what}_without.rrd")
        with_them, without = ((tmp_path / f"{what}{end}.rrd").stat().st_size for end in ("", "_without"))
        assert with_them > without + 0.9 * pictures


def test_other_programs_read_the_pictures(filmed) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    from lfd.record.png import decode_png

    with (filmed / "recordings" / "episode_000000.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        _, _, _, message = next(reader.iter_decoded_messages(topics=["/cameras/agentview"]))
    assert message.format == "png"
    assert decode_png(bytes(message.data)).shape == (48, 64, 3)


def test_a_camera_that_is_not_there_is_named_with_those_that_are(short, tmp_path) -> None:
    with pytest.raises(
        UnknownName, match="unknown camera 'agent'; known: agentview, birdview, .*Did you mean 'agentview'"
    ):
        record(replace(short, cameras=("agent",)), tmp_path / "out", tables={})
    assert not (tmp_path / "out").exists()


def test_a_task_without_an_expert_loses_nothing(short, tmp_path) -> None:
    out = tmp_path / "out"
    record(replace(short, episodes=1, max_seconds=10.0), out, tables={})
    before = sorted(out.iterdir())
    with pytest.raises(UnknownName, match="unknown task of a scripted expert 'PickPlaceMilk'; known: Door, Lift"):
        record(replace(short, task="PickPlaceMilk"), out, tables={}, overwrite=True)
    assert sorted(out.iterdir()) == before


def test_rerun_shows_every_topic_as_what_it_is(filmed, tmp_path) -> None:
    from rerun.experimental import RrdReader

    recording, saved = filmed / "recordings" / "episode_000000.mcap", tmp_path / "episode.rrd"
    command = [Path(sys.executable).with_name("rerun"), "mcap", "convert", recording, "-o", saved]
    subprocess.run(command, check=True, capture_output=True)
    shown: dict[str, set[str]] = {}
    for chunk in RrdReader(str(saved)).stream():
        columns = [field.metadata or {} for field in chunk.to_record_batch().schema]
        components = {column[b"rerun:component"].decode() for column in columns if b"rerun:component" in column}
        shown.setdefault(str(chunk.entity_path), set()).update(components)
    expected = {
        "/joint_states/position": "Scalars:scalars",
        "/joint_states/velocity": "Scalars:scalars",
        "/action": "Scalars:scalars",
        "/step": "Scalars:scalars",
        "/ee_pose": "InstancePoses3D:quaternions",
        "/objects/cube/pose": "InstancePoses3D:translations",
        "/tf": "Transform3D:translation",
        "/cameras/agentview": "EncodedImage:blob",
        "/events": "TextLog:text",
        "/task": "TextDocument:text",
    }
    for path, component in expected.items():
        assert component in shown[path], f"{path} shows {shown[path]}"


def test_a_recording_that_is_gone_on_with_ends_as_if_never_interrupted(short, tmp_path) -> None:
    record(short, tmp_path / "whole", tables={})
    record(replace(short, episodes=1), tmp_path / "resumed", tables={})
    done = record(short, tmp_path / "resumed", tables={}, resume=True)
    assert done.episodes == 3
    whole, resumed = recordings_in([tmp_path / "whole"]), recordings_in([tmp_path / "resumed"])
    assert [path.name for path in whole] == [path.name for path in resumed]
    for one, other in zip(whole, resumed, strict=True):
        np.testing.assert_array_equal(read_episode(one).sim_states, read_episode(other).sim_states)
    with pytest.raises(OutputError, match=r"was recorded with action_noise = .*; go on with the same recipe"):
        record(replace(short, action_noise=0.01), tmp_path / "resumed", tables={}, resume=True)
    with pytest.raises(OutputError, match="holds no recordings to go on with; leave --resume out"):
        record(short, tmp_path / "none", tables={}, resume=True)
