"""Which world a dataset or a policy is about, and what a policy sees of it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.dataset.lerobot_writer import INFO
from lfd.core.artifact import read_manifest
from lfd.core.channels import ENVIRONMENT_STATE, STATE
from lfd.core.errors import InputError, PolicyError
from lfd.policies.adoption import CONFIG, about_foreign, facts_of

IMAGES = "observation.images."


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A world, and the features by which policies know it."""

    task: str
    robot: str
    controller: str
    control_hz: int
    """Control steps a second [Hz]."""
    names: Mapping[str, tuple[str, ...]]
    """Feature (observation.state, observation.environment_state) to its components, such as `ee_pos.x`."""
    pictures: Mapping[str, tuple[int, int]]
    """Camera to the height and width [pixels] of its pictures."""
    action_size: int


def read_setting(folder: Path) -> Setting:
    """The setting of a dataset, of a policy of lfd's, or of one that `lerobot-train` saved.

    Raises `InputError` for a folder that is none of them, and what reading a dataset or policy raises.
    """
    if (folder / INFO).is_file():
        return _of_dataset(DatasetFiles(folder))
    if not (folder / CONFIG).is_file():
        raise InputError(
            f"{folder} is no dataset (it has no {INFO}) and no policy (no {CONFIG}); give the folder of "
            "`lfd convert`, for example --env.dataset=outputs/dataset"
        )
    about = read_manifest(folder)
    about = about_foreign(folder, None) if about is None else about
    if about.get("kind") != "policy":
        raise PolicyError(f"{folder}/manifest.json is not a policy's; give the dataset that it was trained on")
    action = json.loads((folder / CONFIG).read_text(encoding="utf-8"))["output_features"]["action"]
    return Setting(
        **_facts(about),
        names={feature: tuple(names) for feature, names in about["features"].items()},
        pictures={name.removeprefix(IMAGES): (size[0], size[1]) for name, size in about.get("cameras", {}).items()},
        action_size=action["shape"][0],
    )


def _of_dataset(files: DatasetFiles) -> Setting:
    pictures = {}
    for feature, told in files.features.items():
        if told["dtype"] in ("image", "video") and feature.startswith(IMAGES):
            pictures[feature.removeprefix(IMAGES)] = (told["shape"][0], told["shape"][1])
    return Setting(
        **_facts(facts_of(files)),
        names={f: files.names(f) for f in (STATE, ENVIRONMENT_STATE) if f in files.features},
        pictures=pictures,
        action_size=files.features["action"]["shape"][0],
    )


def _facts(about: Mapping[str, Any]) -> dict[str, Any]:
    return {key: about[key] for key in ("task", "robot", "controller", "control_hz")}
