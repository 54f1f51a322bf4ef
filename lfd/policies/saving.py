"""Policies and tensors to disk, with the operating system's own errors where there is no room."""

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor


def save_policy(folder: Path, policy: Any, before: Any, after: Any) -> None:
    """Write a policy with its pre- and post-processor as LeRobot does.

    Raises `OSError` when the disk is full.
    """
    weights = {key: value.clone() for key, value in policy.state_dict().items()}  # parameters may share memory
    with _disk_errors(folder):
        policy.save_pretrained(folder, state_dict=weights)
        before.save_pretrained(folder)
        after.save_pretrained(folder)


def save_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors as safetensors.

    Raises `OSError` when the disk is full.
    """
    from safetensors.torch import save_file

    with _disk_errors(path):
        save_file(dict(tensors), path)


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """safetensors gives the system's error number in the text of an error of its own only."""
    from safetensors import SafetensorError

    try:
        yield
    except SafetensorError as error:
        number = re.search(r"\(os error (\d+)\)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from error
