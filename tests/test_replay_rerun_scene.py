"""Rerun files of several episodes, read back."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from lfd.planning.signed_distances import Capsule
from lfd.replay.clip import EXPERT, UNSOLVED, Clip, clip_of
from lfd.replay.rerun_scene.blueprints import FIRST_PLOTS, kind_of
from lfd.replay.rerun_scene.clips import AMBER, OUTCOME_COLORS
from lfd.replay.rerun_scene.outputs import Sheet, write_file
from tests.conftest import call_json
from tests.test_replay import columns


def recordings(rrd: Path) -> dict[str, list[str]]:
    """Names of the recordings in a Rerun file, and their entities."""
    from rerun.experimental import RrdReader

    found = {}
    for store in RrdReader(str(rrd)).recordings():
        entities: list[str] = []
        name = ""
        for chunk in RrdReader(str(rrd)).stream(store=store).to_chunks():
            batch = chunk.to_record_batch()
            entities.append(str(chunk.entity_path))
            for column in batch.schema.names:
                if column.endswith("RecordingInfo:name"):
                    name = batch[column].to_pylist()[0][0]
        found[name] = entities
    return found


def verified(rrd: Path) -> None:
    subprocess.run([Path(sys.executable).parent / "rerun", "rrd", "verify", rrd], check=True, capture_output=True)


def color(held: dict[str, list[pa.RecordBatch]], entity: str) -> tuple[int, int, int]:
    for batch in held[entity]:
        for name in batch.schema.names:
            if name.endswith("colors"):
                packed = batch[name].to_pylist()[0][0]
                return (packed >> 24, packed >> 16 & 255, packed >> 8 & 255)
    raise AssertionError(f"{entity} has no colour")


def test_all_episodes_are_recordings_of_one_file(thread, tmp_path) -> None:
    rrd = tmp_path / "all.rrd"
    printed = call_json(["replay", str(thread.recordings), "--all", "--save", str(rrd)])
    assert printed["bytes"] == rrd.stat().st_size
    verified(rrd)
    found = recordings(rrd)
    assert sorted(found) == ["0: solved, episode_000000.mcap", "1: solved, episode_000001.mcap"]
    for entities in found.values():
        assert "/world/cube_main" in entities
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.rrd"]


def test_episodes_side_by_side_have_a_root_each(thread, tmp_path) -> None:
    rrd = tmp_path / "beside.rrd"
    call_json(["replay", str(thread.recordings), "--episodes", "1,0", "--beside", "--save", str(rrd)])
    verified(rrd)
    held = columns(rrd)
    for root, number in (("clip_0", 1), ("clip_1", 0)):
        clip = clip_of(thread.recordings, number)
        places = max(held[f"/{root}/world/cube_main"], key=lambda batch: batch.num_rows)
        name = next(n for n in places.schema.names if n.endswith("translation"))
        moved = np.array([row[0] for row in places[name].to_pylist()])
        np.testing.assert_allclose(moved, clip.positions["cube"], atol=1e-6)


def test_each_mesh_is_there_once_and_simplified(thread, tmp_path) -> None:
    rrd = tmp_path / "one.rrd"
    clip = clip_of(thread.recordings, 0)
    write_file([Sheet("x", (clip,))], rrd, overwrite=False)
    assert clip.model is not None
    held, corners = columns(rrd), 0
    for batches in held.values():
        with_mesh = [b for b in batches if any(name.endswith("vertex_positions") for name in b.schema.names)]
        assert sum(batch.num_rows for batch in with_mesh) <= 1
        for batch in with_mesh:
            name = next(n for n in batch.schema.names if n.endswith("vertex_positions"))
            corners += len(batch[name].to_pylist()[0])
    assert 10_000 < corners < 0.25 * clip.model.nmeshvert
    assert rrd.stat().st_size < 4e6


@pytest.mark.parametrize("success", [True, False, None])
def test_the_gripper_s_path_has_the_colour_of_the_outcome(success, thread, tmp_path) -> None:
    clip = clip_of(thread.dataset, 0)
    pieces = {"ee_overruled": (clip.positions["ee"][3:6],)}
    clip = replace(clip, success=success, model=None, qpos=None, pieces=pieces)
    write_file([Sheet("x", (clip,))], tmp_path / "x.rrd", overwrite=False)
    held = columns(tmp_path / "x.rrd")
    assert color(held, "/world/paths/ee") == OUTCOME_COLORS[success]
    assert color(held, "/world/paths/ee_overruled") == AMBER


def test_states_scenes_and_odd_names_arrive(tmp_path) -> None:
    times = np.arange(4) / 10
    clip = Clip(
        "odd", times, {}, {"cube_pos - ee": np.zeros((4, 3))}, None, None,
        states={"task": ((0.0, UNSOLVED), (0.2, "solved"))},
        shapes=(Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.2),), about={"task": "look"},
    )  # fmt: skip
    write_file([Sheet("odd", (clip,))], tmp_path / "odd.rrd", overwrite=False)
    held = columns(tmp_path / "odd.rrd")
    assert "/world/paths/cube_pos_-_ee" in held
    assert "/world/scene/capsule_0" in held
    assert "/about" in held
    changes = max(held["/states/task"], key=lambda batch: batch.num_rows)
    name = next(n for n in changes.schema.names if n.endswith("state"))
    assert [row[0] for row in changes[name].to_pylist()] == [UNSOLVED, "solved"]


def test_every_kind_has_its_plots(thread) -> None:
    clip = clip_of(thread.recordings, 0)
    assert kind_of(clip) == "episode"
    action = clip.curves["plots/action/applied"]
    for path, kind in (("plots/weights", "correction"), ("plots/belief", "interaction")):
        assert kind_of(replace(clip, curves={**clip.curves, path: action})) == kind
        assert FIRST_PLOTS[kind][0] == path
    assert kind_of(replace(clip, states={"who acts": ((0.0, EXPERT),)})) == "shared_control"
    assert kind_of(replace(clip, curves={"plots/observation.state": action})) == "features"
