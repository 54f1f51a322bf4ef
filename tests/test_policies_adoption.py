import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfd.core.artifact import read_manifest
from lfd.core.errors import DatasetError, PolicyError
from lfd.policies.acting import LearnedPolicy
from lfd.policies.adoption import about_foreign
from tests.conftest import call_json


@pytest.fixture
def foreign(thread, tmp_path: Path) -> Path:
    """The thread's policy as `lerobot-train` would have saved it: without lfd's manifest, with train_config.json."""
    folder = tmp_path / "pretrained_model"
    shutil.copytree(thread.policy, folder, ignore=shutil.ignore_patterns("manifest.json", "metrics.jsonl", "loss.png"))
    _told(folder, {"dataset": {"repo_id": "local/lift", "root": str(thread.dataset)}, "steps": 20, "seed": 5})
    return folder


def _told(folder: Path, trained: dict[str, Any]) -> None:
    (folder / "train_config.json").write_text(json.dumps(trained))


def test_what_the_dataset_says_is_what_our_own_manifest_says(thread, foreign: Path) -> None:
    about, own = about_foreign(foreign, None), read_manifest(thread.policy)
    assert own is not None
    for key in ("kind", "policy", "robot", "controller", "task", "control_hz", "features"):
        assert about[key] == own[key], key
    assert about["seed"] == 5
    assert about["recipe"]["train"] == {"steps": 20, "seed": 5}
    assert about["recipe"]["eval"] == own["recipe"]["eval"]
    assert about["recipe"]["policy"]["type"] == "bc_mlp"


def test_an_adopted_policy_acts_as_it_does_with_our_manifest(thread, foreign: Path, lift_world) -> None:
    seen = lift_world.reset(np.random.default_rng(0))
    actions = []
    for folder in (thread.policy, foreign):
        policy = LearnedPolicy(folder, lift_world.spec)
        policy.reset(np.random.default_rng(1))
        actions.append(policy.act(seen).action)
    np.testing.assert_array_equal(*actions)


def test_the_dataset_can_be_named(thread, foreign: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(thread.dataset, tmp_path / "moved")
    _told(foreign, {"dataset": {"repo_id": "local/lift", "root": str(tmp_path / "gone")}})
    with pytest.raises(PolicyError, match=r"gone, which is not there now; say where the dataset is: --dataset FOLDER"):
        about_foreign(foreign, None)
    assert about_foreign(foreign, moved)["task"] == "Lift"


def test_a_dataset_of_the_hub_or_none_must_be_named(foreign: Path) -> None:
    _told(foreign, {"dataset": {"repo_id": "someone/lift", "root": None}})
    with pytest.raises(PolicyError, match=r"'someone/lift' of the Hugging Face hub; say where .* --dataset FOLDER"):
        about_foreign(foreign, None)
    (foreign / "train_config.json").unlink()
    with pytest.raises(PolicyError, match=r"neither lfd's manifest.json nor LeRobot's train_config.json.*--dataset"):
        about_foreign(foreign, None)


def test_another_dataset_is_refused(thread, foreign: Path, tmp_path: Path) -> None:
    other = shutil.copytree(thread.dataset, tmp_path / "other")
    info = json.loads((other / "meta" / "info.json").read_text())
    features = info["features"]
    features["observation.state"] |= {"shape": [3], "names": ["ee_pos.x", "ee_pos.y", "ee_pos.z"]}
    (other / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(
        PolicyError, match=r"takes observation.state of the shape \[18\], .* has \[3\]; name the dataset"
    ):
        about_foreign(foreign, other)
    del features["observation.state"]
    (other / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(PolicyError, match=r"takes observation.state, .*other has action, .*--dataset FOLDER"):
        about_foreign(foreign, other)


def test_a_dataset_that_does_not_name_its_world_is_refused(thread, foreign: Path, tmp_path: Path) -> None:
    bare = shutil.copytree(thread.dataset, tmp_path / "bare")
    (bare / "manifest.json").unlink()
    with pytest.raises(DatasetError, match=r"does not say the dataset's robot, controller, task, control_hz"):
        about_foreign(foreign, bare)


def test_the_cameras_of_a_policy_and_their_size(thread, foreign: Path, tmp_path: Path) -> None:
    config = json.loads((foreign / "config.json").read_text())
    config["input_features"]["observation.images.front"] = {"type": "VISUAL", "shape": [3, 48, 64]}
    (foreign / "config.json").write_text(json.dumps(config))
    with pytest.raises(PolicyError, match=r"takes observation.images.front, .* has action, .*--dataset FOLDER"):
        about_foreign(foreign, None)
    seeing = shutil.copytree(thread.dataset, tmp_path / "seeing")
    info = json.loads((seeing / "meta" / "info.json").read_text())
    info["features"]["observation.images.front"] = {"dtype": "video", "shape": [48, 64, 3], "names": None}
    (seeing / "meta" / "info.json").write_text(json.dumps(info))
    about = about_foreign(foreign, seeing)
    assert about["cameras"] == {"observation.images.front": [48, 64]}
    assert set(about["features"]) == {"observation.state", "observation.environment_state"}


def test_the_folder_around_the_policy_is_answered_with_the_right_one(foreign: Path, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=rf"it has no config.json; did you mean {foreign}\?"):
        about_foreign(foreign.parent, None)
    with pytest.raises(PolicyError, match="it has no config.json; `lfd train RECIPE --out"):
        about_foreign(tmp_path / "nothing", None)
    for text, said in (("{", "is no JSON"), ("[]", "is no table"), ("{}", "lacks type or input_features")):
        (foreign / "config.json").write_text(text)
        with pytest.raises(PolicyError, match=said):
            about_foreign(foreign, None)


@pytest.mark.slow
def test_lerobots_own_training_makes_a_policy_that_lfd_adopts(thread, tmp_path: Path) -> None:
    from tests.test_run_lerobot_env import lerobot

    out = tmp_path / "train"
    lerobot(
        tmp_path / "home",
        "lerobot-train",
        "--policy.discover_packages_path=lfd.policies",
        *("--policy.type=bc_mlp", "--policy.device=cpu"),
        *("--dataset.repo_id=local/lift", f"--dataset.root={thread.dataset}"),
        *("--steps=20", "--num_workers=0", "--batch_size=32", f"--output_dir={out}"),
    )
    folder = out / "checkpoints" / "last" / "pretrained_model"
    about, own = about_foreign(folder, None), read_manifest(thread.policy)
    assert own is not None
    assert {key: about[key] for key in ("policy", "robot", "controller", "task", "control_hz", "features")} == {
        key: own[key] for key in ("policy", "robot", "controller", "task", "control_hz", "features")
    }
    with pytest.raises(PolicyError, match="did you mean"):
        about_foreign(out, None)
    report = call_json(["eval", str(folder), "--episodes", "2", "--out", str(tmp_path / "run")])
    assert report["episodes"] == 2
