"""Checkpoints of a training, beside the place of its policy, until that is there.

`OUT.training/checkpoint` is a whole policy folder with, in `training_state.safetensors`, all that decides how the
training goes on. A new one takes the old one's place by rename.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lfd.core.artifact import new_folder, write_json
from lfd.core.errors import OutputError
from lfd.policies.saving import save_tensors
from lfd.train.descent import Descent
from lfd.train.fitting import Course, course_of, plain_of, tensors_of

CHECKPOINT = "checkpoint"
STATE, COURSE = "training_state.safetensors", "training_course.json"


def training_folder(out: Path) -> Path:
    """Where the training of the policy `out` keeps its checkpoint."""
    return out.with_name(f"{out.name}.training")


def save_checkpoint(
    out: Path, descent: Descent, course: Course, recipe: Mapping[str, Any], write_policy: Callable[[Path], None]
) -> None:
    """Keep the present state of a training; `recipe` is what it must be gone on with."""
    with new_folder(training_folder(out) / CHECKPOINT, overwrite=True) as part:
        with descent.averaged():
            write_policy(part)
        save_tensors(part / STATE, {**descent.state(), **tensors_of(course)})
        write_json(part / COURSE, {"recipe": dict(recipe), "course": plain_of(course)})


def load_checkpoint(out: Path, descent: Descent, recipe: Mapping[str, Any]) -> Course:
    """Bring a descent to where the training of `out` was interrupted, and return what it had gone through.

    Raises `OutputError` when there is no checkpoint, or one of another recipe or dataset.
    """
    from safetensors.torch import load_file

    folder = training_folder(out) / CHECKPOINT
    if not (folder / STATE).is_file():
        raise OutputError(f"{folder} holds no checkpoint to go on with; leave --resume out to begin")
    kept = json.loads((folder / COURSE).read_text(encoding="utf-8"))
    now = json.loads(json.dumps(dict(recipe)))
    for key in {**kept["recipe"], **now}:
        if kept["recipe"].get(key) != now.get(key):
            raise OutputError(
                f"{folder} was trained with {key} = {kept['recipe'].get(key)}, now it is {now.get(key)}; "
                "go on with the same recipe and dataset, or begin anew without --resume"
            )
    tensors = load_file(folder / STATE)
    descent.load_state({key: value for key, value in tensors.items() if not key.startswith("best.")})
    return course_of(kept["course"], tensors)
