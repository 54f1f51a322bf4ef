"""Policies that LeRobot's own training saved, without a manifest of lfd's.

Such a folder says how the network is built and where its dataset was (`train_config.json`); the dataset says
which robot, controller and task it is about, at which rate, and which components make up each feature.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.core.errors import DatasetError, PolicyError

CONFIG = "config.json"
TRAIN_CONFIG = "train_config.json"
FACTS = ("robot", "controller", "task", "control_hz")
"""What a dataset's manifest says about the world that it was recorded in."""
EVAL = {"episodes": 50, "seed": 0, "max_seconds": 10.0, "hold_seconds": 0.5}
"""The `[eval]` table of a policy that has none; times are taken from the dataset's demonstrations where it has them."""
TRAINED_HERE = ("checkpoints/last/pretrained_model", "pretrained_model")


def about_foreign(folder: Path, dataset: Path | None) -> dict[str, Any]:
    """What the manifest of a policy says (`lfd.policies.acting.about_policy`), for one that `lerobot-train` saved.

    `dataset` is the folder it was trained on; without it, the place that `train_config.json` names. Raises
    `PolicyError` when the folder is no policy of LeRobot's, or when the dataset is not to be found or another one;
    `DatasetError` for a dataset that does not say what its world was.
    """
    config = _config(folder)
    trained = _read(folder / TRAIN_CONFIG) if (folder / TRAIN_CONFIG).is_file() else {}
    files = DatasetFiles(dataset or _training_data(folder, trained))
    facts = facts_of(files)
    record = files.manifest.get("recipe", {}).get("record", {})
    times = {key: record[key] for key in ("max_seconds", "hold_seconds") if key in record}
    return {
        "kind": "policy",
        "policy": config["type"],
        "seed": trained.get("seed"),
        **facts,
        **_inputs(folder, config, files),
        "recipe": {
            "policy": config,
            "train": {key: trained[key] for key in ("steps", "batch_size", "seed") if key in trained},
            "eval": {**EVAL, **times},
        },
        "parents": {str(files.root): ""},
    }


def facts_of(files: DatasetFiles) -> dict[str, Any]:
    """Robot, controller, task and rate of a dataset.

    Raises `DatasetError` when its manifest does not say them.
    """
    missing = [key for key in FACTS if not files.manifest.get(key)]
    if missing:
        raise DatasetError(
            f"{files.root}/manifest.json does not say the dataset's {', '.join(missing)}, which a world needs; convert "
            "the recordings with `lfd convert`"
        )
    return {key: files.manifest[key] for key in FACTS}


def _config(folder: Path) -> dict[str, Any]:
    """LeRobot's configuration of the policy in a folder."""
    if not (folder / CONFIG).is_file():
        inside = next((folder / name for name in TRAINED_HERE if (folder / name / CONFIG).is_file()), None)
        advice = f"did you mean {inside}?" if inside else f"`lfd train RECIPE --out {folder}` makes one"
        raise PolicyError(f"{folder} is no policy: it has no {CONFIG}; {advice}")
    config = _read(folder / CONFIG)
    if "type" not in config or not isinstance(config.get("input_features"), dict):
        raise PolicyError(f"{folder / CONFIG} is not LeRobot's: it lacks type or input_features; save the policy again")
    return config


def _training_data(folder: Path, trained: Mapping[str, Any]) -> Path:
    """The dataset that the policy says it was trained on."""
    told = trained.get("dataset", {})
    if not told:
        reason = f"has neither lfd's manifest.json nor LeRobot's {TRAIN_CONFIG}, so its robot and inputs are unknown"
    elif not told.get("root"):
        reason = f"was trained on {told.get('repo_id')!r} of the Hugging Face hub"
    elif not Path(told["root"]).is_dir():
        reason = f"was trained on {told['root']}, which is not there now"
    else:
        return Path(told["root"])
    raise PolicyError(f"{folder} {reason}; say where the dataset is: --dataset FOLDER")


def _inputs(folder: Path, config: Mapping[str, Any], files: DatasetFiles) -> dict[str, Any]:
    """`features`, each input with the names of its components, and `cameras`, each with height and width [pixels]."""
    features, cameras = {}, {}
    for feature, told in config["input_features"].items():
        is_picture = told["type"] == "VISUAL"
        if feature not in files.features:
            known = ", ".join(sorted(files.features))
            raise PolicyError(f"{folder} takes {feature}, {files.root} has {known}; name its dataset: --dataset FOLDER")
        has = files.features[feature]["shape"]
        wants = (
            [*told["shape"][1:], told["shape"][0]] if is_picture else told["shape"]
        )  # a network's channels are first
        if list(has) != list(wants):
            raise PolicyError(
                f"{folder} takes {feature} of the shape {wants}, {files.root} has {has}; name the dataset that it was "
                "trained on: --dataset FOLDER"
            )
        if is_picture:
            cameras[feature] = list(has[:2])
        else:
            features[feature] = list(files.names(feature))
    return {"features": features, "cameras": cameras}


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise PolicyError(f"{path} is no JSON ({error}); save the policy again") from error
    if not isinstance(content, dict):
        raise PolicyError(f"{path} is no table; save the policy again")
    return content
