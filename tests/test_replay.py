import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import pytest

from lfd.core.errors import InputError
from lfd.record.episode_file import read_episode, recordings_in
from lfd.replay.clip import clip_of
from lfd.replay.rerun_scene import replay
from lfd.replay.shown_mesh import vertex_normals
from lfd.replay.verify import verify_episode, verify_replay
from lfd.worlds.cameras import load_model
from tests.conftest import call_json


def test_a_recording_is_executed_again_without_deviation(thread) -> None:
    for index in range(2):
        found = verify_replay(thread.recordings, index)
        assert (found.deviation, found.first_step, found.differences) == (0.0, None, ())
    evaluated = call_json(["replay", str(thread.run), "--episode", "1", "--verify"])
    assert evaluated["deviation"] == 0
    assert evaluated["stepper"] == "compiled"


def test_another_action_is_noticed(thread) -> None:
    episode = read_episode(recordings_in([thread.recordings])[0])
    actions = episode.actions.copy()
    actions[5] *= 0.99
    found = verify_episode(replace(episode, actions=actions))
    assert found.deviation > 0
    assert found.first_step == 6


def columns(rrd: Path) -> dict[str, list[pa.RecordBatch]]:
    """What a Rerun file holds, by entity."""
    from rerun.experimental import RrdReader

    batches: dict[str, list[pa.RecordBatch]] = {}
    for chunk in RrdReader(str(rrd)).stream().to_chunks():
        batches.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    return batches


def test_the_rerun_file_holds_the_recorded_motion(thread, tmp_path) -> None:
    rrd = tmp_path / "episode.rrd"
    printed = call_json(["replay", str(thread.recordings), "--episode", "1", "--save", str(rrd)])
    assert printed["bytes"] == rrd.stat().st_size
    subprocess.run([Path(sys.executable).parent / "rerun", "rrd", "verify", rrd], check=True, capture_output=True)
    episode = read_episode(recordings_in([thread.recordings])[1])
    held = columns(rrd)

    def column(entity: str, component: str) -> np.ndarray:
        for batch in held[entity]:
            for name in batch.schema.names:
                if name.endswith(component) and batch.num_rows == len(episode) + 1:
                    return np.array([np.asarray(row[0]) for row in batch[name].to_pylist()])
        raise AssertionError(f"{entity} has no {component}: {held[entity]}")

    np.testing.assert_allclose(column("/world/cube_main", "translation"), episode.observations["cube_pos"], atol=1e-6)
    joints = [np.asarray(row) for row in _scalars(held["/plots/joints/position"], len(episode) + 1)]
    np.testing.assert_array_equal(joints, episode.observations["joint_pos"])
    actions = np.array(list(_scalars(held["/plots/action/applied"], len(episode) + 1)))
    np.testing.assert_array_equal(actions[:-1], episode.actions)
    meshes = [name for name in held if name.startswith("/world/robot0_link")]
    assert len(meshes) > 20


def _scalars(batches, rows):
    batch = next(b for b in batches if b.num_rows == rows)
    name = next(n for n in batch.schema.names if n.endswith("scalars"))
    return batch[name].to_pylist()


def test_a_dataset_moves_the_same_model_as_its_recordings(thread) -> None:
    recorded, learned = clip_of(thread.recordings, 0), clip_of(thread.dataset, 0)
    assert recorded.qpos is not None
    assert learned.qpos is not None
    assert learned.model is not None
    np.testing.assert_allclose(learned.qpos, recorded.qpos[:-1], atol=1e-6)
    np.testing.assert_allclose(learned.positions["ee"], recorded.positions["ee"][:-1], atol=1e-6)
    assert learned.curves["plots/joints/position"].unit == "rad"


def test_the_kinematics_of_the_clip_give_the_recorded_gripper(thread) -> None:
    clip = clip_of(thread.recordings, 0)
    assert clip.model is not None
    assert clip.qpos is not None
    data = mujoco.MjData(clip.model)
    site = clip.model.site("gripper0_right_grip_site").id
    for row in (0, 10, -1):
        data.qpos[:] = clip.qpos[row]
        mujoco.mj_kinematics(clip.model, data)
        np.testing.assert_allclose(data.site_xpos[site], clip.positions["ee"][row], atol=1e-9)


def test_normals_of_a_sphere_point_outwards() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><mesh name="s" builtin="sphere" params="2"/></asset></mujoco>'
        if mujoco.mj_versionString() >= "3.3.9"
        else "<mujoco><asset><mesh name='s' vertex='1 0 0 -1 0 0 0 1 0 0 -1 0 0 0 1 0 0 -1'/></asset></mujoco>"
    )
    normals = vertex_normals(model.mesh_vert, model.mesh_face)
    outward = model.mesh_vert / np.linalg.norm(model.mesh_vert, axis=1, keepdims=True)
    assert (np.sum(normals * outward, axis=1) > 0.9).all()


def test_a_recorded_model_is_loaded_from_the_installed_meshes(thread) -> None:
    episode = read_episode(recordings_in([thread.recordings])[0])
    assert load_model(episode.model_xml).nmesh > 20


def test_without_a_screen_the_way_out_is_named(thread, lfd_fails, monkeypatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "write a file with --save" in lfd_fails("replay", thread.recordings)


def test_what_cannot_be_shown(thread, lfd_fails, tmp_path) -> None:
    assert "episodes 0 to 1, not 7" in lfd_fails(
        "replay", thread.recordings, "--episode", "7", "--save", tmp_path / "x"
    )
    assert "episodes 0 to 1, not 7" in lfd_fails("replay", thread.dataset, "--episode", "7", "--save", tmp_path / "x")
    assert "nothing at" in lfd_fails("replay", tmp_path / "no", "--save", tmp_path / "x.rrd")
    kept = tmp_path / "kept.rrd"
    kept.write_text("mine")
    assert "exists already" in lfd_fails("replay", thread.recordings, "--save", kept)
    assert kept.read_text() == "mine"
    assert "cannot write" in lfd_fails("replay", thread.recordings, "--save", kept / "x.rrd")
    with pytest.raises(InputError):
        replay(clip_of(thread.recordings, 0), save=kept)
