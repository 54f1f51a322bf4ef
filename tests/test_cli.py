import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lfd.cli import main
from lfd.record.episode_file import read_episode, recordings_in
from tests.conftest import BC, LIFT, ROOT, call_json

COMMANDS = ("record", "convert", "train", "eval", "sweep", "replay", "info", "doctor", "bench", "demo")


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
    assert "'bc_mpl'; known: bc_mlp. Did you mean 'bc_mlp'?" in error
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
    assert printed["parameters"] == (18 + 7) * 8 + 8 + 8 * 7 + 7
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


@pytest.mark.parametrize("command", ["record", "convert", "replay"])
def test_a_disk_that_takes_no_more_leaves_nothing_half_written(command, thread, tmp_path) -> None:
    """A limit on the size of files stands for the full disk: writes fail in the same places."""
    import resource

    arguments = {
        "record": ["record", str(LIFT), "--episodes", "1", "--out", str(tmp_path / "out")],
        "convert": ["convert", str(thread.recordings), "--out", str(tmp_path / "out")],
        "replay": ["replay", str(thread.recordings), "--save", str(tmp_path / "out.rrd")],
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
