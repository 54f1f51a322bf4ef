import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lfd.cli import main
from lfd.record.episode_file import read_episode, recordings_in
from tests.conftest import BC, LIFT, ROOT, call_json

COMMANDS = (
    "record", "convert", "verify", "export", "trace", "recover", "train", "eval", "sweep", "replay", "info", "doctor",
    "bench", "demo", "plan", "features", "irl", "compare", "correct", "reward", "interact",
)  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert f"example: lfd {command}" in shown
    assert "--json" in shown


def test_help_names_the_way_from_a_demonstration_to_a_policy(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out
    for command in COMMANDS:
        assert f"    {command} " in shown
    assert "lfd record datasets/lift_panda.toml" in shown


def test_help_loads_none_of_the_heavy_libraries() -> None:
    code = (
        "import sys, lfd, lfd.cli\n"
        "try: lfd.cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'lerobot', 'robosuite', 'mujoco', 'rerun', 'mcap', 'numpy', 'rich'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=ROOT)


def test_help_answers_within_a_few_starts_of_python() -> None:
    """A ratio, since the machine's speed is not ours: the limit is half a second where Python starts in 50 ms."""

    def seconds(arguments: list[str]) -> float:
        began = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, capture_output=True, cwd=ROOT)
        return time.perf_counter() - began

    python = min(seconds(["-c", "pass"]) for _ in range(5))
    assert min(seconds(["-m", "lfd.cli", "--help"]) for _ in range(5)) < 10 * python


def test_unknown_names_in_recipes(lfd_fails, tmp_path) -> None:
    out = tmp_path / "out"
    lift = LIFT.read_text()

    def recipe(old: str, new: str) -> Path:
        path = tmp_path / "recipe.toml"
        path.write_text(lift.replace(old, new))
        return path

    assert "unknown task 'Lft'; known: Door, Lift" in lfd_fails("record", recipe('"Lift"', '"Lft"'), "--out", out)
    assert "unknown robot 'pand'; known: baxter" in lfd_fails("record", recipe('"panda"', '"pand"'), "--out", out)
    error = lfd_fails("record", recipe("episodes = 50", "epsiodes = 50"), "--out", out)
    assert "unknown key" in error
    assert "Did you mean 'episodes'?" in error
    assert "no recipe" in lfd_fails("record", tmp_path / "none.toml", "--out", out)
    assert "record.episodes" not in lfd_fails("record", LIFT, "--episodes", "0", "--out", out)
    assert not out.exists()


def test_unknown_policy(lfd_fails, thread, tmp_path) -> None:
    recipe = tmp_path / "policy.toml"
    recipe.write_text(BC.read_text().replace("bc_mlp", "bc_mpl"))
    error = lfd_fails("train", recipe, "--dataset", thread.dataset, "--out", tmp_path / "out")
    assert "unknown policy type" in error
    assert "'bc_mpl'; known: act, bc_mlp, bc_rnn, diffusion. Did you mean 'bc_mlp'?" in error
    assert not (tmp_path / "out").exists()


def test_outputs_that_cannot_be_made(lfd_fails, thread, tmp_path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    for command in (
        ("record", LIFT),
        ("convert", thread.recordings),
        ("train", BC, "--dataset", thread.dataset),
        ("eval", thread.policy),
    ):
        assert "is a file, expected a folder" in lfd_fails(*command, "--out", file)
        assert "cannot make" in lfd_fails(*command, "--out", file / "inside")
    for command, taken in (
        (("record", LIFT), thread.recordings),
        (("train", BC, "--dataset", thread.dataset), thread.policy),
        (("eval", thread.policy), thread.run),
    ):
        assert "exists already" in lfd_fails(*command, "--out", taken)
    assert file.read_text() == "mine"


def test_overwriting_replaces_what_was_there(thread, tmp_path) -> None:
    out = tmp_path / "recordings"
    for seed in ("1", "2"):
        call_json(["record", str(LIFT), "--episodes", "1", "--seed", seed, "--out", str(out), "--overwrite"])
    (path,) = recordings_in([out])
    assert read_episode(path).metadata.seed == 2


def test_any_key_of_a_recipe_can_be_set(thread, tmp_path) -> None:
    out = tmp_path / "policy"
    options = ["--set", "policy.hidden_sizes=[8]", "--set", "train.steps=2"]
    printed = call_json(["train", str(BC), "--dataset", str(thread.dataset), "--out", str(out), *options])
    assert printed["parameters"] == (18 + 10) * 8 + 8 + 8 * 7 + 7
    assert json.loads((out / "manifest.json").read_text())["recipe"]["policy"]["hidden_sizes"] == [8]


@pytest.mark.parametrize("what", ["recordings", "dataset", "policy", "run"])
def test_info_knows_every_artifact(what, thread, capfd) -> None:
    assert main(["info", str(getattr(thread, what)), "--json"]) == 0
    kind = {"run": "evaluation"}.get(what, what)
    assert json.loads(capfd.readouterr().out)["kind"] == kind


def test_info_of_a_recording_and_of_a_recipe(thread, capfd, lfd_fails, tmp_path) -> None:
    assert main(["info", str(recordings_in([thread.recordings])[0])]) == 0
    shown = capfd.readouterr().out
    assert "/joint_states" in shown
    assert "20.0 Hz" in shown
    assert main(["info", str(LIFT)]) == 0
    assert "Control steps a second [Hz]." in capfd.readouterr().out
    assert "nothing that lfd knows" in lfd_fails("info", tmp_path / "none")
    assert "no manifest.json" in lfd_fails("info", tmp_path)


def test_ctrl_c_keeps_finished_episodes(tmp_path) -> None:
    out = tmp_path / "recordings"
    command = [sys.executable, "-m", "lfd.cli", "record", str(LIFT), "--out", str(out)]
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells ignore it in background jobs
    )
    deadline = time.monotonic() + 120
    while len(list(out.glob("*.mcap"))) < 2:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "interrupted; finished episodes are kept" in errors
    assert "Traceback" not in errors
    kept = recordings_in([out])
    assert len(kept) >= 2
    assert all(read_episode(path).success for path in kept)
    assert list(out.glob("*.part")) == []


@pytest.mark.parametrize("command", ["record", "convert", "replay", "train", "train with checkpoints"])
def test_a_disk_that_takes_no_more_leaves_nothing_half_written(command, thread, tmp_path) -> None:
    """A limit on the size of files stands for the full disk: writes fail in the same places."""
    import resource

    train = ["train", str(BC), "--dataset", str(thread.dataset), "--steps", "20"]
    arguments = {
        "record": ["record", str(LIFT), "--episodes", "1", "--out", str(tmp_path / "out")],
        "convert": ["convert", str(thread.recordings), "--out", str(tmp_path / "out")],
        "replay": ["replay", str(thread.recordings), "--save", str(tmp_path / "out.rrd")],
        "train": [*train, "--out", str(tmp_path / "out")],
        "train with checkpoints": [*train, "--set", "train.checkpoint_every=5", "--out", str(tmp_path / "out")],
    }[command]
    done = subprocess.run(
        [sys.executable, "-m", "lfd.cli", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
    )
    assert done.returncode == 2, done.stderr
    assert "cannot write" in done.stderr
    assert "Traceback" not in done.stderr
    left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert left == (["manifest.json"] if command == "record" else [])


def test_the_way_of_the_data_in_json(recorded, tmp_path, capfd) -> None:
    from dataclasses import replace

    from tests.small_recordings import part, toml, write_all

    def printed(*arguments: object) -> dict:
        capfd.readouterr()
        assert main([*map(str, arguments), "--json"]) == 0
        out = capfd.readouterr().out
        assert len(out.splitlines()) == 1
        return json.loads(out)

    a, b, out = tmp_path / "a", tmp_path / "b", tmp_path / "dataset"
    paths = write_all(a, *(part(recorded, begin, begin + 6) for begin in (0, 6, 12)))
    write_all(b, replace(part(recorded, 18, 24), successes=np.arange(6) == 5))
    paths[1].write_bytes(paths[1].read_bytes()[:-600])
    recipe = toml(tmp_path / "recipe.toml", failures=True)
    first = printed("convert", a, "--recipe", recipe, "--out", out, "--skip-bad")
    assert (first["out"], first["episodes"], first["frames"], first["left_out"]) == (str(out), 2, 12, 0)
    (why,) = first["skipped"]
    assert str(paths[1]) in why
    again = printed("convert", b, "--append", "--jobs", "1", "--out", out)
    assert (again["episodes"], again["frames"], again["skipped"]) == (1, 6, [])
    verified = printed("verify", out, a, b)
    assert verified == {"dataset": str(out), "numbers_equal": first["compared"] + again["compared"]}
    assert printed("export", out, "--to", "mcap", "--out", tmp_path / "mcap") == {
        "out": str(tmp_path / "mcap"),
        "episodes": 3,
    }
    assert printed("export", b, "--to", "robomimic", "--out", tmp_path / "b.hdf5")["episodes"] == 1
    traced = printed("trace", out)
    assert [(parent["kind"], parent["state"]) for parent in traced["parents"]] == 3 * [("file", "intact")]
    (saved,) = printed("recover", a)["files"]
    assert (saved["path"], saved["episode"]) == (f"{paths[1]}.damaged", str(paths[1]))
    assert main(["convert", str(a), "--recipe", str(recipe), "--out", str(tmp_path / "text"), "--skip-bad"]) == 0
    assert "recovered" in capfd.readouterr().out  # what a person should know of an episode is shown


def test_a_dataset_that_differs_from_its_sources_ends_with_exit_code_1(recorded, tmp_path, capfd) -> None:
    from tests.small_recordings import part, toml, write_all

    write_all(tmp_path / "a", part(recorded, 0, 6))
    write_all(tmp_path / "b", part(recorded, 1, 7))
    recipe, out = toml(tmp_path / "recipe.toml"), tmp_path / "out"
    assert main(["convert", str(tmp_path / "a"), "--recipe", str(recipe), "--out", str(out)]) == 0
    capfd.readouterr()
    assert main(["verify", str(out), str(tmp_path / "b")]) == 1
    captured = capfd.readouterr()
    assert "observation.state differs from the recording in row 0; convert it again" in captured.err
    assert captured.out == ""


def test_bad_input_on_the_way_of_the_data(recorded, lfd_fails, tmp_path) -> None:
    from tests.small_recordings import part, toml, write_all

    write_all(tmp_path / "a", part(recorded, 0, 6))
    a, out, none, recipe = tmp_path / "a", tmp_path / "out", tmp_path / "none", toml(tmp_path / "recipe.toml")
    foreign = "tests/data/rosbag2parquet_base_msgs.mcap"
    assert f"no recording {none}; `lfd record RECIPE --out {none}` makes some" in lfd_fails(
        "convert", none, "--out", out
    )
    assert "no [convert] table, and no recording keeps one; name a recipe" in lfd_fails("convert", a, "--out", out)
    assert "no recipe" in lfd_fails("convert", a, "--recipe", none, "--out", out)
    assert "is no recording of lfd: it has no metadata 'lfd.episode'. Name a recipe with [resample]" in lfd_fails(
        "convert", foreign, "--recipe", recipe, "--out", out
    )
    assert "is no dataset that could grow; leave out --append" in lfd_fails(
        "convert", a, "--recipe", recipe, "--append", "--out", out
    )
    broken = tmp_path / "broken.toml"
    broken.write_text(recipe.read_text() + "[video]\ncodec = 'mpeg2'\n")
    assert "unknown codec in" in lfd_fails("convert", a, "--recipe", broken, "--out", out)
    broken.write_text(recipe.read_text().replace('"action"', '"actions"'))
    assert "'actions'; known: action, expert_action" in lfd_fails("convert", a, "--recipe", broken, "--out", out)
    broken.write_text(recipe.read_text().replace('"action"', '"expert_action"'))
    assert "no expert was asked in this episode" in lfd_fails("convert", a, "--recipe", broken, "--out", out)
    broken.write_text(recipe.read_text() + "cameras = ['front']\n")
    assert "episode_000000.mcap: unknown camera 'front'" in lfd_fails("convert", a, "--recipe", broken, "--out", out)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "empty holds no .mcap file" in lfd_fails("convert", empty, "--recipe", recipe, "--out", out)
    assert not out.exists()
    assert "none is no LeRobot dataset: it has no meta/info.json" in lfd_fails("verify", none, a)
    assert "no recording" in lfd_fails("export", none, "--to", "mcap", "--out", out)
    assert "nothing at" in lfd_fails("trace", none)
    assert "no folder" in lfd_fails("recover", none)
    for text, said in (("{", "is no JSON"), ('{"codebase_version": "v2.1"}', "of version v2.1, expected v3.0")):
        (none / "meta").mkdir(parents=True, exist_ok=True)
        (none / "meta/info.json").write_text(text)
        assert said in lfd_fails("verify", none, a)


@pytest.mark.slow
def test_doctor_examines_this_machine() -> None:
    found = call_json(["doctor"])
    assert found["simulation"].startswith("ok")
    assert found["lerobot"] == "ok: 0.6.1"
    assert {"rendering egl", "gpu", "devices", "screen"} <= set(found)


def test_a_renderer_that_is_not_installed_is_named(monkeypatch, capfd, tmp_path) -> None:
    """`import mujoco` itself would crash."""
    from ctypes.util import find_library

    from lfd.cli import main

    if find_library("OSMesa"):
        pytest.skip("OSMesa is installed here")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert main(["record", str(LIFT), "--out", str(tmp_path / "out")]) == 1
    assert "OSMesa is not installed. On Debian or Ubuntu: `apt install libosmesa6`" in capfd.readouterr().err
