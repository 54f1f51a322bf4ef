"""Shared by all tests: shapes are enforced, and the thread is run once, small, on the real libraries."""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import install_import_hook

os.environ["HF_HUB_OFFLINE"] = "1"
CHECKED = (
    "core.rotations",
    "core.protocols",
    "worlds.rollout",
    "worlds.robosuite_world",
    "worlds.observing",
    "worlds.gymnasium_env",
    "worlds.vector_world",
    "worlds.cameras",
    "experts",
    "convert",
    "data",
    "policies",
    "run",
    "replay",
    "rewards",
    "planning.arm_model",
    "planning.arm_planner",
    "planning.bellman",
    "planning.demonstrations",
    "planning.dynamics",
    "planning.grid_worlds",
    "planning.highway",
    "planning.scenes",
    "planning.tabular_mdp",
    "planning.trajectory_costs",
    "reward_learning.hull",
    "reward_learning.margin_loop",
    "reward_learning.maxent_sampled",
    "reward_learning.maxent_tabular",
)
install_import_hook([f"lfd.{name}" for name in CHECKED], "beartype.beartype")

ROOT = Path(__file__).parents[1]
LIFT = ROOT / "datasets" / "lift_panda.toml"
BC = ROOT / "policies" / "bc_mlp.toml"


@pytest.fixture(autouse=True)
def _in_checkout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


@pytest.fixture(autouse=True)
def _ordinary_priority() -> Iterator[None]:
    """LeRobot's encoder leaves the process of a test with real-time priority, and browsers beside it stand still."""
    from lfd.core.processes import ordinary_priority

    yield
    ordinary_priority()


@pytest.fixture(scope="session")
def lift_world():
    """The real robosuite Lift with a Panda, built once."""
    from lfd import make_world

    return make_world("Lift", "panda", 20)


@pytest.fixture(scope="session")
def recorded(lift_world, tmp_path_factory: pytest.TempPathFactory):
    """An episode of 40 random actions, as it is read from its recording."""
    from lfd.record.episode_file import read_episode
    from tests.test_record_episode_file import record_steps

    path = tmp_path_factory.mktemp("recorded") / "episode.mcap"
    record_steps(lift_world, path, np.random.default_rng(5).uniform(-0.5, 0.5, (40, 7)))
    return read_episode(path)


@dataclass(frozen=True)
class Thread:
    """What each stage of the thread left on disk, and the JSON that it printed."""

    recordings: Path
    dataset: Path
    policy: Path
    run: Path
    printed: dict[str, dict]


@pytest.fixture(scope="session")
def thread(tmp_path_factory: pytest.TempPathFactory) -> Thread:
    """Two demonstrations, twenty training steps and two evaluation episodes, through the command line."""
    folder = tmp_path_factory.mktemp("thread")
    recordings, dataset, policy, run = (folder / name for name in ("recordings", "dataset", "policy", "run"))
    commands = [
        ["record", str(LIFT), "--episodes", "2", "--seed", "3", "--out", str(recordings)],
        ["convert", str(recordings), "--out", str(dataset)],
        ["train", str(BC), "--dataset", str(dataset), "--steps", "20", "--out", str(policy)],
        ["eval", str(policy), "--episodes", "2", "--out", str(run)],
    ]
    return Thread(recordings, dataset, policy, run, {command[0]: call_json(command) for command in commands})


def call_json(arguments: list[str]) -> dict:
    """Run a command with --json in a process of its own; its standard output must be one JSON object."""
    import subprocess
    import sys

    done = subprocess.run(
        [sys.executable, "-m", "lfd.cli", *arguments, "--json"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture
def lfd_fails(capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must end with exit code 2 and one sentence; returns the sentence."""

    def run(*arguments: str | Path) -> str:
        from lfd.cli import main

        capfd.readouterr()
        assert main([str(a) for a in arguments]) == 2
        captured = capfd.readouterr()
        assert captured.out == ""
        assert "Traceback" not in captured.err
        return captured.err

    return run


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
