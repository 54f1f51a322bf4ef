import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from lfd.convert.verify import verify
from lfd.core.errors import VerificationError
from lfd.record.episode_file import read_episode, recordings_in
from tests.conftest import LIFT


def test_lerobot_opens_the_dataset_and_finds_the_recorded_numbers(thread) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset: Any = LeRobotDataset("lfd/test", root=thread.dataset, video_backend="pyav")
    episodes = [read_episode(path) for path in recordings_in([thread.recordings])]
    assert dataset.num_episodes == len(episodes) == 2
    assert dataset.num_frames == sum(map(len, episodes)) == thread.printed["convert"]["frames"]
    assert dataset.fps == 20
    row = dataset[len(episodes[0]) + 3]  # frame 3 of the second episode
    second = episodes[1]
    expected = np.concatenate([second.observations[n][3] for n in ("joint_pos", "gripper_pos", "gripper_vel")])
    np.testing.assert_array_equal(row["observation.state"][:11].numpy(), expected.astype(np.float32))
    np.testing.assert_array_equal(
        row["observation.environment_state"][:3].numpy(), second.observations["cube_pos"][3].astype(np.float32)
    )
    assert second.expert_actions is not None
    np.testing.assert_array_equal(row["action"].numpy(), second.expert_actions[3].astype(np.float32))
    assert row["task"] == "lift the red cube off the table"
    assert float(row["timestamp"]) == pytest.approx(3 / 20)
    assert dataset.features["observation.state"]["names"][0] == "joint_pos.robot0_joint1"
    last = dataset[len(dataset) - 1]
    assert bool(last["next.done"])
    assert bool(last["next.success"])


def test_the_manifest_names_every_recording_by_its_hash(thread) -> None:
    from lfd.core.artifact import sha256

    manifest = json.loads((thread.dataset / "manifest.json").read_text())
    paths = recordings_in([thread.recordings])
    assert manifest["parents"] == {str(path): sha256(path) for path in paths}
    assert manifest["recipe"]["convert"]["action"] == "expert_action"


def test_verification_finds_a_changed_number(thread, tmp_path) -> None:
    import shutil

    copy = tmp_path / "dataset"
    shutil.copytree(thread.dataset, copy)
    assert verify(copy, [thread.recordings]) == thread.printed["convert"]["compared"]
    file = next((copy / "data").rglob("*.parquet"))
    table = pq.read_table(file)
    actions = table["action"].to_pylist()
    actions[5][2] += 1e-6
    column = table.schema.get_field_index("action")
    import pyarrow as pa

    pq.write_table(table.set_column(column, "action", pa.array(actions, table.schema.field("action").type)), file)
    with pytest.raises(VerificationError, match="action differs from the recording"):
        verify(copy, [thread.recordings])
    with pytest.raises(VerificationError, match="number of episodes: the dataset says 2, the recordings say 1"):
        verify(thread.dataset, recordings_in([thread.recordings])[:1])


def test_recordings_that_do_not_go_together_are_refused(thread, lfd_fails, lift_world, tmp_path) -> None:
    from lfd import make_world
    from tests.test_record_episode_file import record_steps

    record_steps(make_world("Lift", "panda", 10), tmp_path / "slow.mcap", np.zeros((2, 7)))
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(LIFT.read_text().replace('"expert_action"', '"action"'))
    sources = (thread.recordings, tmp_path / "slow.mcap")
    error = lfd_fails("convert", *sources, "--recipe", recipe, "--out", tmp_path / "dataset")
    assert "slow.mcap has control_hz 10, the episodes before it have 20" in error
    assert not (tmp_path / "dataset").exists()


def test_a_damaged_recording_leaves_no_dataset(thread, lfd_fails, tmp_path) -> None:
    for path in recordings_in([thread.recordings]):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    broken: Path = tmp_path / "episode_000001.mcap"
    broken.write_bytes(broken.read_bytes()[:-1000])
    error = lfd_fails("convert", tmp_path, "--out", tmp_path / "dataset")
    assert str(broken) in error
    assert sorted(p.name for p in tmp_path.iterdir()) == ["episode_000000.mcap", "episode_000001.mcap"]


def test_an_existing_dataset_is_not_replaced(thread, lfd_fails) -> None:
    error = lfd_fails("convert", thread.recordings, "--out", thread.dataset)
    assert "exists already; choose another --out, or add --overwrite" in error


def test_a_recipe_that_names_what_is_not_there(thread, lfd_fails, tmp_path) -> None:
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('[convert]\nstate = ["ee_poz"]\nenvironment_state = []\naction = "action"')
    error = lfd_fails("convert", thread.recordings, "--recipe", recipe, "--out", tmp_path / "dataset")
    assert "unknown channel 'ee_poz'" in error
    recipe.write_text('[convert]\nstate = ["ee_pos"]\nenvironment_state = ["sphere_pos"]\naction = "action"')
    error = lfd_fails("convert", thread.recordings, "--recipe", recipe, "--out", tmp_path / "dataset")
    assert "unknown channel 'sphere_pos'; known: action, cube_pos" in error
