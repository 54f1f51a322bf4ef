import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.to_lerobot import convert
from lfd.convert.verify import verify
from lfd.core.episode import Episode
from lfd.core.errors import DatasetError, EpisodeError, LfdError, RecordingError, VerificationError
from lfd.record.episode_file import read_episode, recordings_in
from lfd.record.episode_writing import write_episode
from tests.conftest import LIFT
from tests.small_recordings import CAMERA, filmed, part, recipe, write_all
from tests.test_convert_lerobot_writer import files_in


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
    recipe.write_text(LIFT.read_text().replace('"expert_action"', '"action"').replace("failures = false", ""))
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


def with_nan(episode: Episode) -> Episode:
    """An episode that could not be made: its parts were checked."""
    actions = episode.actions.copy()
    actions[3, 2] = np.nan
    object.__setattr__(episode, "actions", actions)
    return episode


@pytest.fixture
def faulty(recorded, tmp_path) -> tuple[Path, dict[str, str]]:
    """Recordings of which some cannot be used, and what is to be said of those."""
    folder, slow = tmp_path / "recordings", part(recorded, 0, 6, control_hz=10)
    paths = write_all(
        folder,
        part(recorded, 0, 6),
        part(recorded, 6, 12),
        replace(slow, times=2 * slow.times),
        with_nan(part(recorded, 12, 18)),
        part(recorded, 18, 24),
        part(recorded, 24, 30, controller="JOINT_VELOCITY"),
        part(recorded, 30, 36),
    )
    damaged = bytearray(paths[1].read_bytes())
    damaged[len(damaged) // 2] ^= 1
    paths[1].write_bytes(damaged)
    return folder, {
        paths[1].name: "is truncated, damaged or no MCAP file",
        paths[2].name: "has control_hz 10, the episodes before it have 20",
        paths[3].name: "channel 'action' is not finite at step 3",
        paths[5].name: "has controller JOINT_VELOCITY, the episodes before it have OSC_POSE",
    }


def test_what_cannot_be_used_is_left_out_and_listed(faulty, tmp_path) -> None:
    folder, reasons = faulty
    out = tmp_path / "dataset"
    done = convert([folder], out, recipe=recipe(), skip_bad=True)
    assert (done.episodes, done.frames) == (3, 18)
    assert len(done.skipped) == len(reasons)
    manifest = json.loads((out / "manifest.json").read_text())
    for said, (path, kept), (name, why) in zip(done.skipped, manifest["skipped"].items(), reasons.items(), strict=True):
        assert path == str(folder / name)
        assert kept == said
        assert name in said
        assert why in said
    assert sorted(Path(path).name for path in manifest["parents"]) == [f"episode_00000{i}.mcap" for i in (0, 4, 6)]
    assert verify(out, [folder]) == done.compared
    with pytest.raises(VerificationError, match="number of episodes: the dataset says 3, the recordings say 2"):
        verify(out, [folder / "episode_000000.mcap", folder / "episode_000004.mcap"])


def test_without_the_wish_the_first_that_cannot_be_used_ends_it(faulty, tmp_path) -> None:
    folder, reasons = faulty
    for name, why in reasons.items():
        with pytest.raises((RecordingError, EpisodeError, DatasetError), match=f"{name}.*{why}"):
            convert([folder / "episode_000000.mcap", folder / name], tmp_path / "dataset", recipe=recipe())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recordings"]


def test_nothing_is_written_when_all_are_left_out(faulty, tmp_path) -> None:
    folder, reasons = faulty
    bad = [folder / name for name in list(reasons)[:1]]
    with pytest.raises(DatasetError, match="not one episode is left to convert: .*000001.mcap is truncated"):
        convert(bad, tmp_path / "dataset", recipe=recipe(), skip_bad=True)
    with pytest.raises(DatasetError, match="not one episode is left to convert: all are failures"):
        convert([folder / "episode_000000.mcap"], tmp_path / "dataset", recipe=recipe(failures=False))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recordings"]


def test_failures_are_left_out_where_the_recipe_says_so(recorded, tmp_path) -> None:
    episodes = [part(recorded, begin, begin + 6) for begin in (0, 6, 12)]
    won = replace(episodes[1], successes=np.arange(6) == 5)
    write_all(tmp_path / "recordings", episodes[0], won, episodes[2])
    done = convert([tmp_path / "recordings"], tmp_path / "won", recipe=recipe(failures=False))
    assert (done.episodes, done.left_out) == (1, 2)
    np.testing.assert_array_equal(
        DatasetFiles(tmp_path / "won").read(0).columns["action"], won.actions.astype(np.float32)
    )
    assert verify(tmp_path / "won", [tmp_path / "recordings"]) == done.compared
    assert convert([tmp_path / "recordings"], tmp_path / "all", recipe=recipe()).episodes == 3


def contents(root: Path) -> dict[str, bytes]:
    """The files of a dataset; of its manifest what does not depend on the time."""
    found = {name: (root / name).read_bytes() for name in files_in(root)}
    manifest = json.loads(found.pop("manifest.json"))
    del manifest["made"]
    return found | {"manifest.json": json.dumps(manifest).encode()}


@pytest.fixture(scope="module")
def several(recorded, tmp_path_factory) -> Path:
    """Seven recordings with pictures; one is damaged."""
    folder = tmp_path_factory.mktemp("several")
    paths = write_all(folder, *(filmed(part(recorded, begin, begin + 8)) for begin in range(7)))
    paths[4].write_bytes(paths[4].read_bytes()[:-20])
    return folder


def test_the_number_of_processes_does_not_show_in_the_dataset(several, tmp_path) -> None:
    for jobs in (1, 2):
        wanted = recipe(video={"codec": "h264"}, cameras=[CAMERA])
        done = convert([several], tmp_path / str(jobs), recipe=wanted, jobs=jobs, skip_bad=True)
        assert done.episodes == 6
    one, two = (contents(tmp_path / str(jobs)) for jobs in (1, 2))
    assert one == two


def test_a_fault_in_a_process_is_said_as_in_this_one(several, tmp_path) -> None:
    said = []
    for jobs in (1, 2):
        with pytest.raises(RecordingError, match="episode_000004.mcap is truncated") as error:
            convert([several], tmp_path / "out", recipe=recipe(), jobs=jobs)
        said.append(str(error.value))
    assert said[0] == said[1]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_cluster_makes_the_same_dataset_and_names_the_files_of_this_machine(several, tmp_path) -> None:
    from lfd.cluster import connect

    wanted = recipe(video={"codec": "h264"}, cameras=[CAMERA])
    convert([several], tmp_path / "here", recipe=wanted, skip_bad=True)
    with connect("local") as cluster:
        convert([several], tmp_path / "there", recipe=wanted, cluster=cluster, skip_bad=True)
        with pytest.raises(RecordingError, match=f"{several}/episode_000004.mcap is truncated"):
            convert([several], tmp_path / "out", recipe=wanted, cluster=cluster)
    here, there = contents(tmp_path / "here"), contents(tmp_path / "there")
    assert list(here) == list(there)
    for name, content in here.items():
        assert there[name] == content, name


MEMORY = """
import sys
from pathlib import Path
from lfd.convert.to_lerobot import convert
from lfd.convert.sources import SourceRecipe
import pyarrow.parquet, lfd.record.mcap_file
def peak():  # not ru_maxrss, which begins with that of the parent
    return next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
if __name__ == "__main__":
    before = peak()
    wanted = SourceRecipe.load(Path(sys.argv[2]))
    convert([Path(sys.argv[1])], Path(sys.argv[3]), recipe=wanted, jobs=1)
    print(before, peak())
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from /proc")
def test_memory_does_not_grow_with_the_episodes(recorded, tmp_path) -> None:
    from tests.small_recordings import toml

    write_episode(tmp_path / "episode.mcap", part(recorded, 0, 40))
    content, wanted = (tmp_path / "episode.mcap").read_bytes(), toml(tmp_path / "recipe.toml")
    grown = {}
    for count in (200, 1000):
        folder = tmp_path / str(count)
        folder.mkdir()
        for index in range(count):
            (folder / f"episode_{index:06d}.mcap").write_bytes(content)
        command = [sys.executable, "-c", MEMORY, folder, wanted, tmp_path / f"dataset_{count}"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        before, after = map(int, done.stdout.split())
        grown[count] = after - before
        assert len(DatasetFiles(tmp_path / f"dataset_{count}")) == count
    assert grown[200] > 1000  # [kB]: it was measured
    assert grown[1000] < 1.3 * grown[200], grown
    print(grown)


def die(shared: None, unit: int) -> None:
    os._exit(9)


def test_a_process_that_dies_is_said() -> None:
    from lfd.core.processes import ProcessMap

    with pytest.raises(LfdError, match="a worker process died, for example for lack of memory; try it with --jobs 1"):
        list(ProcessMap(2)(die, None, [1, 2, 3]))


def test_a_folder_of_both_kinds_gives_both_and_missing_files_a_sentence(thread, lfd_fails, tmp_path) -> None:
    from lfd.convert.sources import SourceRecipe, units_of

    both = tmp_path / "both"
    shutil.copytree(thread.recordings, both)
    (both / "damaged.hdf5").write_bytes(b"no HDF5")
    units = units_of([both], SourceRecipe(where="test"))
    assert [unit.paths[0].name for unit in units] == ["damaged.hdf5", "episode_000000.mcap", "episode_000001.mcap"]
    for command in (("convert",), ("export", "--to", "mcap")):
        assert "no recording" in lfd_fails(*command, tmp_path / "nope.hdf5", "--out", tmp_path / "out")
        assert "damaged.hdf5" in lfd_fails(*command, both, "--out", tmp_path / "out")
    convert([both], tmp_path / "rest", skip_bad=True)
    assert verify(tmp_path / "rest", [both]) > 0
    assert not (tmp_path / "out").exists()
