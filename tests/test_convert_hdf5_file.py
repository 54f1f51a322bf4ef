import time
from collections import Counter
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from lfd.convert.foreign.mapping import map_recipe
from lfd.convert.hdf5 import reading as hdf5_process
from lfd.convert.hdf5.demo_file import rate_of, read_demo, read_file
from lfd.convert.hdf5.stored_samples import frames_of_demo
from lfd.convert.hdf5.worker import TIMES_FILE
from lfd.core.errors import EpisodeError, RecordingError, UnknownName
from tests.hdf5_files import DAMAGED, LIFT, REACHING, ROWS, STACK, mutated, opened, small_file

MEMORY = 4 * 2**20
"""Bytes that reading a small file may take beyond four times its size; the bound that ends the process is higher."""


def test_what_a_file_of_robosuite_says() -> None:
    file = read_file(LIFT)
    assert (file.layout, file.env_name, file.robots, file.version) == ("robosuite", "Lift", ("Panda",), "1.4.0")
    assert file.demos == ("demo_2", "demo_3")
    assert file.lengths == {"demo_2": 510, "demo_3": 392}
    assert file.control_hz is None
    assert file.made == "2022-11-16T14:13:58"
    assert file.controllers["type"] == "OSC_POSE"
    demo = read_demo(file, "demo_3")
    assert demo.states is not None
    assert (demo.actions.shape, demo.states.shape) == ((392, 7), (392, 32))
    assert (demo.rewards, demo.dones, dict(demo.obs)) == (None, None, {})
    assert rate_of(file, demo) == 20  # by the clock in its states
    with opened(LIFT) as there:
        np.testing.assert_array_equal(demo.actions, there["data/demo_3/actions"])
        assert demo.model_xml == there["data/demo_3"].attrs["model_file"]
    assert read_demo(read_file(STACK), "demo_1").model_xml == "model_1.xml"


def test_a_file_of_robomimic_whose_counts_differ_from_its_rows() -> None:
    with pytest.raises(RecordingError, match=r"total says 1495 rows, its 1 demonstrations have 151; --trust-rows"):
        read_file(REACHING)
    file = read_file(REACHING, trust_rows=True)
    assert (file.layout, file.env_name) == ("robomimic", "ReachingFrankaBC")
    with pytest.raises(
        EpisodeError, match=r"demo_1: its attribute num_samples says 251, 'actions' has 151 rows; --skip"
    ):
        read_demo(file, "demo_1")
    demo = read_demo(file, "demo_1", trust_rows=True, obs=["robot0_eef_pos"])
    assert {name: rows.shape for name, rows in demo.obs.items()} == {"robot0_eef_pos": (151, 3)}
    assert len(read_demo(file, "demo_1", trust_rows=True).obs) == 11


def test_stored_observations_become_rows_without_a_simulator() -> None:
    tables = {
        "resample": {"fps": 20, "task": "reach the target", "robot": "panda", "max_gap_s": 0.1},
        "map": {
            "ee": {
                "topic": "obs/robot0_eef_pos",
                "feature": "observation.state",
                "unit": "m",
                "components": ["x", "y", "z"],
            },
            "turn": {"topic": "robot0_eef_quat", "feature": "observation.state", "unit": "1"},
            "near": {
                "topic": "target_pos",
                "field": "data[0:2]",
                "feature": "observation.environment_state",
                "unit": "m",
            },
            "act": {"topic": "actions", "feature": "action", "unit": "controller"},
        },
    }
    file = read_file(REACHING, trust_rows=True)
    (frames,) = frames_of_demo(file, "demo_1", map_recipe(tables, "recipe.toml"), trust_rows=True)
    assert (len(frames), frames.fps) == (151, 20)
    assert frames.names["observation.state"][3:] == ("turn.w", "turn.x", "turn.y", "turn.z")
    with opened(REACHING) as there:
        demo = there["data/demo_1"]
        np.testing.assert_array_equal(frames.columns["action"], np.float32(demo["actions"]))
        np.testing.assert_array_equal(
            frames.columns["observation.state"][:, :3], np.float32(demo["obs/robot0_eef_pos"])
        )
        turned = np.roll(demo["obs/robot0_eef_quat"], 1, axis=1)
        signs = np.sign((turned * frames.columns["observation.state"][:, 3:]).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(frames.columns["observation.state"][:, 3:], signs * turned, atol=1e-6)
    tables["map"]["near"]["topic"] = "target"
    with pytest.raises((UnknownName, EpisodeError), match=r"target"):
        frames_of_demo(file, "demo_1", map_recipe(tables, "recipe.toml"), trust_rows=True)


def _drop(demo: Any) -> None:
    del demo["actions"]


def _empty(demo: Any) -> None:
    for name in ("actions", "states", "rewards", "dones", "obs/a", "obs/b"):
        width = demo[name].shape[1:]
        del demo[name]
        demo[name] = np.zeros((0, *width))


def _short(demo: Any) -> None:
    del demo["states"]
    demo["states"] = np.zeros((ROWS - 1, 32))


def _nan(demo: Any) -> None:
    demo["obs/b"][5, 2] = np.nan


def _wide(demo: Any) -> None:
    del demo["actions"]
    demo["actions"] = np.zeros((ROWS, 8))


def _text(demo: Any) -> None:
    del demo["rewards"]
    demo["rewards"] = "none"


def _huge(demo: Any) -> None:
    del demo["rewards"]
    demo.create_dataset("rewards", shape=(2**40,), chunks=(2**16,), dtype="f8")


def _elsewhere(demo: Any) -> None:
    del demo["states"]
    demo["states"] = h5py.ExternalLink("other.hdf5", "/states")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_drop, "demo_2 has no dataset 'actions'; it holds dones, obs, rewards, states"),
        (_empty, "demo_2: 'actions' has no rows"),
        (_short, "demo_2: 'states' has 11 rows, 'actions' has 12"),
        (_nan, "demo_2: 'obs/b' is not finite in row 5"),
        (_wide, "demo_2: 'actions' has 8 components, other demonstrations of the file have 7"),
        (_text, "demo_2: 'rewards' is no array of numbers"),
        (_huge, "demo_2: its datasets claim 8,796,093,0"),
        (_elsewhere, "demo_2: 'states' is a link into another file"),
    ],
)
def test_a_bad_demonstration_leaves_the_others_readable(tmp_path: Path, spoil, words: str) -> None:
    path = small_file(tmp_path / "demos.hdf5")
    with opened(path, "r+") as there:
        spoil(there["data/demo_2"])
        there["data"].attrs["total"] = sum(len(d["actions"]) for d in there["data"].values() if "actions" in d)
    file = read_file(path)
    assert len(read_demo(file, "demo_1")) == ROWS
    with pytest.raises(EpisodeError) as caught:
        read_demo(file, "demo_2")
    message = str(caught.value)
    assert words in message
    assert str(path) in message
    assert "--skip-bad leaves it out" in message


def test_what_is_no_demonstration_file_is_said_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    cases: list[tuple[bytes, str]] = [(b"", "is no HDF5 file"), (b"CDF\x01" * 100, "is no HDF5 file")]
    whole = small_file(path).read_bytes()
    cases += [(whole[: len(whole) // 2], "truncated file"), (whole[:60], "the file is damaged")]
    for content, words in cases:
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=words):
            read_file(path)
    with pytest.raises(RecordingError, match=r"nowhere.hdf5 cannot be opened: No such file"):
        read_file(tmp_path / "nowhere.hdf5")
    with opened(path, "w") as file:
        file["numbers"] = np.zeros(3)
    with pytest.raises(RecordingError, match=r"no group 'data' of demonstrations; it holds numbers"):
        read_file(path)
    with opened(path, "w") as file:
        file.create_group("data/demo_1")
    with pytest.raises(RecordingError, match=r"no attribute env_args \(robomimic\) and no env \(robosuite\)"):
        read_file(path)
    small_file(path)
    with opened(path, "r+") as file:
        file["data"].attrs["env_args"] = "{'env_name': 'Lift'}"
    with pytest.raises(RecordingError, match=r"attribute env_args is no JSON"):
        read_file(path)
    with pytest.raises(UnknownName, match=r"unknown demonstration in .* 'demo_7'; known: demo_2, demo_3"):
        read_demo(read_file(LIFT), "demo_7")


def test_the_library_may_die_over_a_file_and_reads_the_next_one(tmp_path: Path) -> None:
    path = small_file(tmp_path / "demos.hdf5")
    hdf5_process._process()._running.kill()
    with pytest.raises(RecordingError, match=r"demos.hdf5: reading it ended the HDF5 library \(SIGKILL\)"):
        read_file(path)
    assert len(read_file(path).demos) == 2


@pytest.mark.parametrize("name", ["loops.hdf5", "crashes.hdf5"])
def test_files_that_libhdf5_loops_or_crashes_over(name: str) -> None:
    with pytest.raises(RecordingError, match=r"the file is damaged: take it from its source again, or leave it out"):
        read_file(DAMAGED / name)
    assert read_file(LIFT).demos


@pytest.mark.slow
def test_ten_thousand_damaged_files_get_an_answer_each(tmp_path: Path, monkeypatch) -> None:
    bases = [
        small_file(tmp_path / "base.hdf5", "robosuite").read_bytes(),
        small_file(tmp_path / "base.hdf5").read_bytes(),
        small_file(tmp_path / "base.hdf5", chunked=True).read_bytes(),
        small_file(tmp_path / "base.hdf5", latest=True).read_bytes(),
    ]
    grown: list[int] = []

    def watched(path: Path, *given) -> hdf5_process.Answer:
        answer = hdf5_process.ask(path, *given)
        grown.append(answer.growth - TIMES_FILE * path.stat().st_size)
        return answer

    monkeypatch.setattr("lfd.convert.hdf5.demo_file.ask", watched)
    rng, outcomes, slowest = np.random.default_rng(1), Counter(), 0.0
    for number in range(10_000):
        path = tmp_path / "case.hdf5"
        path.write_bytes(mutated(bases[number % len(bases)], rng))
        began = time.monotonic()
        outcomes[_outcome(path)] += 1
        slowest = max(slowest, time.monotonic() - began)
    print(f"outcomes {dict(outcomes)}, slowest {slowest:.1f} s, memory beyond 4x {max(grown):,} bytes")
    assert slowest < 30  # less than a second of work, on a busy machine
    assert max(grown) < MEMORY
    assert outcomes["read"] > 0
    assert outcomes["refused"] > 0


def _outcome(path: Path) -> str:
    said = ""
    try:
        file = read_file(path)
        for name in file.demos:
            read_demo(file, name)
    except (RecordingError, EpisodeError) as error:
        said = str(error)
    assert not said or said.startswith(str(path))
    return "process ended" if "reading it" in said else "refused" if said else "read"
