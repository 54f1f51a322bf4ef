"""Datasets that grow: what was there stays as it is, whatever happens to the run that adds to it."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.to_lerobot import convert
from lfd.convert.verify import verify
from lfd.core.artifact import new_folder, sha256
from lfd.core.errors import DatasetError, OutputError, RecipeError, RecordingError
from lfd.record.episode_writing import write_episode
from tests.conftest import ROOT
from tests.small_recordings import filmed, part, recipe, toml, write_all
from tests.test_convert_lerobot_writer import doctor, files_in


@pytest.fixture(scope="module")
def sources(recorded, tmp_path_factory) -> list[Path]:
    """Three folders of recordings; the last has a task of its own."""
    folder = tmp_path_factory.mktemp("sources")
    episode = filmed(recorded)
    write_all(folder / "a", part(episode, 0, 12), part(episode, 5, 20))
    write_all(folder / "b", part(episode, 10, 30))
    write_all(folder / "c", part(episode, 20, 40, instruction="put it back"), part(episode, 0, 7))
    return [folder / "a", folder / "b", folder / "c"]


def with_video(codec: str = "h264") -> Any:
    return recipe(video={"codec": codec}, cameras=["agentview"])


@pytest.fixture(scope="module")
def grown(sources, tmp_path_factory) -> tuple[Path, list[dict[str, tuple[int, bytes]]]]:
    """A dataset made in three rounds, and its files (inode, content) after each."""
    out, after = tmp_path_factory.mktemp("grown") / "dataset", []
    for source in sources:
        convert([source], out, recipe=None if after else with_video(), append=bool(after))
        after.append({name: ((out / name).stat().st_ino, (out / name).read_bytes()) for name in files_in(out)})
    return out, after


def test_what_was_there_is_neither_changed_nor_copied(grown) -> None:
    out, after = grown
    for before, now in pairwise(after):
        for name, file in before.items():
            if name.startswith(("data/", "videos/", "meta/episodes/")) or name == "model.xml":
                assert now[name] == file, name
        assert {name for name in now if name.startswith("data/")} > {n for n in before if n.startswith("data/")}
    assert [path.name for path in out.parent.iterdir()] == ["dataset"]


def test_it_is_the_dataset_made_at_once(grown, sources, tmp_path) -> None:
    out, _ = grown
    done = convert(sources, tmp_path / "at_once", recipe=with_video())
    assert done.episodes == 5
    one, other = DatasetFiles(tmp_path / "at_once"), DatasetFiles(out)
    assert one.info == other.info
    assert one.tasks == other.tasks
    assert list(one.tasks.values()) == [recorded_task(sources), "put it back"]
    for index in range(5):
        a, b = one.read(index), other.read(index)
        assert a.tasks == b.tasks
        for name, rows in a.columns.items():
            np.testing.assert_array_equal(rows, b.columns[name], err_msg=name)
        places = ("data/", "meta/", "videos/")
        told = [{k: v for k, v in files.episodes[index].items() if not k.startswith(places)} for files in (one, other)]
        assert told[0] == told[1]
        for picture, same in zip(one.video(index, FEATURE), other.video(index, FEATURE), strict=True):
            np.testing.assert_array_equal(picture, same)
    stats = [json.loads((root / "meta/stats.json").read_text()) for root in (tmp_path / "at_once", out)]
    assert list(stats[0]) == list(stats[1])
    for name, found in stats[0].items():
        for key, value in found.items():
            np.testing.assert_allclose(value, stats[1][name][key], rtol=1e-9, atol=1e-12, err_msg=f"{name} {key}")
    manifests = [files.manifest for files in (one, other)]
    for key in ("parents", "recipe", "units", "robot", "controller", "skipped"):
        assert manifests[0][key] == manifests[1][key], key


FEATURE = "observation.images.agentview"


def recorded_task(sources: list[Path]) -> str:
    from lfd.record.episode_file import read_episode

    return read_episode(next(sources[0].iterdir())).metadata.instruction


def test_all_sources_together_are_verified(grown, sources) -> None:
    out, _ = grown
    assert verify(out, sources) > 0
    with pytest.raises(Exception, match="number of episodes: the dataset says 5, the recordings say 3"):
        verify(out, sources[:2])
    with pytest.raises(Exception, match="rows: the dataset says"):
        verify(out, sources[::-1])


def test_other_programs_accept_it(grown) -> None:
    doctor(grown[0])


@pytest.mark.slow
def test_lerobot_reads_every_row_of_it(grown) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset: Any = LeRobotDataset("lfd/grown", root=grown[0], video_backend="pyav")
    files = DatasetFiles(grown[0])
    assert (dataset.num_episodes, dataset.num_frames) == (5, 74)
    at = 0
    for index in range(5):
        rows = files.read(index).columns
        for t in (0, len(rows["action"]) - 1):
            row = dataset[at + t]
            np.testing.assert_array_equal(row["action"].numpy(), rows["action"][t])
            seen = row[FEATURE].numpy().transpose(1, 2, 0) * 255
            np.testing.assert_allclose(seen, files.video(index, FEATURE)[t], atol=1.01)  # yuv to rgb by another library
            assert row["task"] == ("put it back" if index == 3 else files.tasks[0])
        at += len(rows["action"])
    assert at == len(dataset)


def test_what_is_in_it_already_is_refused_by_content_and_by_name(grown, sources, tmp_path) -> None:
    out, after = grown
    path = next(sources[1].iterdir())
    with pytest.raises(DatasetError, match=r"episode_000000.mcap is in the dataset already; give only what is new"):
        convert([path], out, append=True)
    shutil.copy(path, tmp_path / "copy.mcap")
    with pytest.raises(DatasetError, match=r"copy.mcap is in the dataset already as .*b/episode_000000.mcap; give"):
        convert([tmp_path], out, append=True)
    assert {name: (out / name).read_bytes() for name in files_in(out)} == {n: f[1] for n, f in after[-1].items()}


def test_a_known_source_that_has_changed_is_refused(recorded, tmp_path) -> None:
    (path,) = write_all(tmp_path / "a", part(recorded, 0, 5))
    convert([path], tmp_path / "dataset", recipe=recipe())
    write_episode(path, part(recorded, 0, 9))
    with pytest.raises(DatasetError, match="is in the dataset already, and has changed since; convert all sources"):
        convert([path], tmp_path / "dataset", append=True)


def test_it_goes_on_by_its_own_recipe_and_by_no_other(recorded, tmp_path) -> None:
    write_all(tmp_path / "a", part(recorded, 0, 5))
    write_all(tmp_path / "b", part(recorded, 5, 9))
    out = tmp_path / "dataset"
    with pytest.raises(OutputError, match="is no dataset that could grow; leave out --append to make one"):
        convert([tmp_path / "a"], out, append=True)
    convert([tmp_path / "a"], out, recipe=recipe())
    with pytest.raises(RecipeError, match=r"\[convert\] is not the one by which .*dataset manifest.json says that"):
        convert([tmp_path / "b"], out, recipe=recipe(state=["ee_pos"]), append=True)
    same = recipe(failures=True, cameras=[])  # in other words
    assert convert([tmp_path / "b"], out, recipe=same, append=True).episodes == 1
    assert len(DatasetFiles(out)) == 2


def test_episodes_of_another_controller_are_refused(recorded, tmp_path) -> None:
    write_all(tmp_path / "a", part(recorded, 0, 5))
    write_all(tmp_path / "b", part(recorded, 5, 9, controller="JOINT_VELOCITY"))
    convert([tmp_path / "a"], tmp_path / "dataset", recipe=recipe())
    with pytest.raises(DatasetError, match="has controller JOINT_VELOCITY, the episodes before it have OSC_POSE"):
        convert([tmp_path / "b"], tmp_path / "dataset", append=True)


def test_a_recording_that_was_skipped_can_be_added_when_it_is_whole(recorded, tmp_path) -> None:
    good, bad = write_all(tmp_path / "a", part(recorded, 0, 5), part(recorded, 5, 12))
    whole, out = bad.read_bytes(), tmp_path / "dataset"
    bad.write_bytes(whole[:-700])
    assert len(convert([good, bad], out, recipe=recipe(), skip_bad=True).skipped) == 1
    assert verify(out, [good, bad]) > 0
    bad.write_bytes(whole)
    convert([bad], out, append=True)
    assert DatasetFiles(out).manifest["skipped"] == {}
    assert verify(out, [good, bad]) == verify(out, [tmp_path / "a"]) > 0


def test_a_failed_round_changes_nothing(recorded, tmp_path) -> None:
    write_all(tmp_path / "a", part(recorded, 0, 5))
    convert([tmp_path / "a"], tmp_path / "dataset", recipe=recipe())
    before = sha256(tmp_path / "dataset")
    (bad,) = write_all(tmp_path / "b", part(recorded, 5, 9))
    bad.write_bytes(bad.read_bytes()[:-100])
    with pytest.raises(RecordingError, match="is truncated, damaged or no MCAP file"):
        convert([bad], tmp_path / "dataset", append=True)
    with pytest.raises(DatasetError, match="not one episode is left to convert: .*truncated"):
        convert([bad], tmp_path / "dataset", append=True, skip_bad=True)
    assert sha256(tmp_path / "dataset") == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "dataset"]


@pytest.mark.parametrize("process", [os.getpid(), 2**22 + 1], ids=["ours", "nobody"])
def test_a_run_killed_between_the_two_renames_is_undone(process, recorded, tmp_path) -> None:
    """The numbers are those of a dead process, and of this one: in a container they repeat."""
    write_all(tmp_path / "a", part(recorded, 0, 5))
    write_all(tmp_path / "b", part(recorded, 5, 9))
    out = tmp_path / "dataset"
    convert([tmp_path / "a"], out, recipe=recipe())
    whole = sha256(out)
    shutil.copytree(out, tmp_path / f".dataset.{process}.part")
    out.rename(tmp_path / f".dataset.{process}.old")
    convert([tmp_path / "b"], out, append=True)
    assert len(DatasetFiles(out)) == 2
    assert verify(out, [tmp_path / "a", tmp_path / "b"]) > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "dataset"]
    # killed after the second rename: the new one stays, the old one goes
    convert([tmp_path / "a"], tmp_path / f".dataset.{process}.old", recipe=recipe())
    assert sha256(tmp_path / f".dataset.{process}.old") == whole
    with pytest.raises(ValueError, match="stop"), new_folder(out, overwrite=True):
        raise ValueError("stop")
    assert len(DatasetFiles(out)) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "dataset"]


def test_what_a_running_process_is_writing_is_left_alone(recorded, tmp_path) -> None:
    running = tmp_path / f".dataset.{os.getppid()}.part"
    running.mkdir()
    write_all(tmp_path / "a", part(recorded, 0, 5))
    convert([tmp_path / "a"], tmp_path / "dataset", recipe=recipe())
    assert running.is_dir()


def lfd(*arguments: object, **environment: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "lfd.cli", *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, env=os.environ | environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


@pytest.mark.slow
def test_a_killed_round_leaves_the_dataset_whole_and_is_cleared_away(recorded, tmp_path) -> None:
    a = write_all(tmp_path / "a", *(part(recorded, i, i + 6) for i in range(4)))
    b = write_all(tmp_path / "b", *(replace(part(recorded, 0, 30), rewards=np.full(30, float(i))) for i in range(120)))
    out, saved = tmp_path / "dataset", tmp_path / "saved"
    convert(a, out, recipe=recipe())
    shutil.copytree(out, saved)
    before = {name: (out / name).read_bytes() for name in files_in(out)}
    chance, caught = random.Random(1), 0
    for _ in range(6):
        process = lfd("convert", *b, "--append", "--out", out)
        while process.poll() is None and not list(tmp_path.glob(f".dataset.{process.pid}.part")):
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.4))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        left = list(tmp_path.glob(".dataset.*"))
        caught += bool(left)
        if out.is_dir() and len(DatasetFiles(out)) == 124:  # it was faster
            shutil.rmtree(out)
            shutil.copytree(saved, out)
        elif out.is_dir():
            assert {name: (out / name).read_bytes() for name in files_in(out)} == before
        else:  # between the two renames; the next run puts it back
            assert any(path.suffix == ".old" for path in left)
    assert caught > 0
    process = lfd("convert", *b, "--append", "--out", out)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert len(DatasetFiles(out)) == 124
    assert verify(out, [tmp_path / "a", tmp_path / "b"]) > 0
    shutil.rmtree(saved)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "dataset"]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are looked for in /proc")
def test_the_processes_of_a_killed_run_end_too(recorded, tmp_path) -> None:
    episodes = [replace(part(recorded, 0, 30), rewards=np.full(30, float(i))) for i in range(300)]
    write_all(tmp_path / "a", *episodes)
    process = lfd(
        *("convert", tmp_path / "a", "--jobs", 2, "--recipe", toml(tmp_path / "recipe.toml")),
        *("--out", tmp_path / "out"),
    )
    while process.poll() is None and not list(tmp_path.glob(".out.*.part/data/*/*.parquet")):
        time.sleep(0.005)
    children = [int(child) for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    assert len(children) >= 2
    process.kill()
    process.communicate(timeout=20)  # they hold its output
    deadline = time.monotonic() + 10
    while any(is_alive(child) for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def is_alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.slow
def test_no_copy_of_it_is_left_in_a_cache(recorded, tmp_path) -> None:
    for name, begin in (("a", 0), ("b", 10), ("c", 20)):
        write_all(tmp_path / name, part(recorded, begin, begin + 10))
    caches = {"HF_HOME": str(tmp_path / "hf"), "HF_DATASETS_CACHE": str(tmp_path / "hf_datasets")}
    written, out = toml(tmp_path / "recipe.toml"), tmp_path / "dataset"
    for command in (
        ("convert", tmp_path / "a", "--recipe", written, "--out", out),
        ("convert", tmp_path / "b", "--append", "--out", out),
        ("convert", tmp_path / "c", "--append", "--out", out),
        ("verify", out, tmp_path / "a", tmp_path / "b", tmp_path / "c"),
    ):
        process = lfd(*command, **caches)
        _, errors = process.communicate()
        assert process.returncode == 0, errors
    for cache in caches.values():
        assert not Path(cache).exists() or files_in(Path(cache)) == []
    assert sum(pq.read_metadata(path).num_rows for path in (out / "data").rglob("*.parquet")) == 30


@pytest.mark.slow
def test_ctrl_c_ends_all_processes_with_one_sentence(recorded, tmp_path) -> None:
    episodes = [replace(part(recorded, 0, 30), rewards=np.full(30, float(i))) for i in range(300)]
    write_all(tmp_path / "a", *episodes)
    command = [sys.executable, "-m", "lfd.cli", "convert", str(tmp_path / "a"), "--jobs", "2"]
    command += ["--recipe", str(toml(tmp_path / "recipe.toml")), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(
        command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it in background jobs
    )  # fmt: skip
    while process.poll() is None and not list(tmp_path.glob(".out.*.part/data/*/*.parquet")):
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGINT)  # as the terminal does: to all of them
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.endswith("lfd convert: interrupted; nothing was written\n")
    assert "Traceback" not in errors
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "recipe.toml"]
