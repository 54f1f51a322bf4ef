"""What a policy folder must not hold: anything that could run a program of its maker's when the policy is loaded.

LeRobot reads weights, statistics and optimizer states with safetensors, which holds numbers only. Two doors stay
open, and are closed here: a pickle in the folder, and a processor whose configuration names a Python class by its
path, which LeRobot imports and calls with arguments of the file's choosing.
"""

import json
from pathlib import Path

from lfd.core.errors import PolicyError

PICKLES = (".bin", ".ckpt", ".joblib", ".pickle", ".pkl", ".pt", ".pt2", ".pth")
"""Endings of files that hold a pickle."""
PROCESSORS = "*processor*.json"


def check_no_pickle(folder: Path) -> None:
    """Raise `PolicyError` for a policy folder with a pickle, or with a processor that names a class to be called."""
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in PICKLES:
            raise PolicyError(
                f"{folder} holds {path.relative_to(folder)}, a pickle, which can run any program when it is read; lfd "
                f"reads safetensors only. If you trust it: `state = torch.load({path.name!r}, weights_only=True)`, "
                '`safetensors.torch.save_file(state, "model.safetensors")`, then delete it'
            )
    for path in sorted(folder.glob(PROCESSORS)):
        for step in _steps(path):
            if not isinstance(step.get("registry_name"), str):
                raise PolicyError(
                    f"{path} has the step {step.get('class', step)!r}, to be imported and called; lfd takes steps of "
                    "LeRobot's registry only (registry_name), so register the class or save the policy without it"
                )


def _steps(path: Path) -> list[dict]:
    try:
        steps = json.loads(path.read_text(encoding="utf-8"))["steps"]
    except (ValueError, KeyError, TypeError) as error:
        raise PolicyError(f"{path} is no processor of LeRobot's ({error}); save the policy again") from error
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        raise PolicyError(f"{path} is no processor of LeRobot's (its steps are no list of tables); save it again")
    return steps
