"""Episodes written as an HDF5 file of robomimic, so that its users can train on them.

    data                    total, env_args (JSON: env_name, type, env_kwargs)
    data/demo_1             num_samples, model_file
    data/demo_1/actions, rewards, dones, states, obs/NAME, next_obs/NAME
    mask/train, mask/valid  names of demonstrations

The file is written under a temporary name and appears when it is whole.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfd.convert.frames import EpisodeFrames
from lfd.convert.hdf5.robomimic_demo import RobomimicDemo, demo_of_episode, demo_of_frames
from lfd.convert.hdf5.writing import new_hdf5
from lfd.core.artifact import versions
from lfd.core.episode import Episode
from lfd.core.errors import DatasetError
from lfd.worlds.environments import controller_configs, robots_of
from lfd.worlds.robots import load_robot, robot_names
from lfd.worlds.tasks import TASKS, load_task

ROBOSUITE, GYM = 1, 2
"""Kinds of environment, as robomimic numbers them."""


@dataclass(frozen=True)
class Exported:
    """What an export wrote."""

    episodes: int
    frames: int
    train: int
    """Episodes of mask/train; the others are in mask/valid."""


def export_episodes(
    episodes: Iterable[Episode], out: Path, *, valid_fraction: float, seed: int, overwrite: bool = False
) -> Exported:
    """Write recordings to `out`; `valid_fraction` of the episodes, drawn by `seed`, go to mask/valid.

    Raises `OutputError` when `out` exists or cannot be written, `DatasetError` for recordings of different worlds.
    """
    return _export(episodes, _world_of_episode, demo_of_episode, out, valid_fraction, seed, overwrite)


def export_frames(
    episodes: Iterable[EpisodeFrames], out: Path, *, valid_fraction: float, seed: int, overwrite: bool = False
) -> Exported:
    """Write the episodes of a dataset to `out`, as `export_episodes` does.

    What is known of their world (`about`: task, robot, controller, control_hz) tells robomimic how to make it.
    """
    return _export(episodes, _world_of_frames, demo_of_frames, out, valid_fraction, seed, overwrite)


def _export[Source](
    episodes: Iterable[Source],
    world_of: Callable[[Source], dict[str, Any]],
    demo_of: Callable[[Source], RobomimicDemo],
    out: Path,
    valid_fraction: float,
    seed: int,
    overwrite: bool,
) -> Exported:
    world: dict[str, Any] | None = None
    frames: list[int] = []
    with new_hdf5(out, overwrite=overwrite) as (file, disk):
        data = file.create_group("data")
        for number, episode in enumerate(episodes, start=1):
            here = world_of(episode)
            if world is not None and here != world:
                raise DatasetError(
                    f"episode {number} is of {here}, the first of {world}; export them into files of their own"
                )
            world = here
            demo = demo_of(episode)
            _write(data.create_group(f"demo_{number}"), demo)
            disk.check()
            frames.append(len(demo.actions))
        if world is None:
            raise DatasetError(f"there is no episode to write to {out}")
        data.attrs["total"] = sum(frames)
        data.attrs["env_args"] = json.dumps(_env_args(world), indent=4)
        train = _write_masks(file, len(frames), valid_fraction, seed)
    return Exported(episodes=len(frames), frames=sum(frames), train=train)


def _write(group: Any, demo: RobomimicDemo) -> None:
    group.attrs["num_samples"] = len(demo.actions)
    if demo.model_xml:
        group.attrs["model_file"] = demo.model_xml
    for name in ("actions", "rewards", "dones", "states"):
        rows = getattr(demo, name)
        if rows is not None:
            group.create_dataset(name, data=rows)
    for folder, seen in (("obs", demo.obs), ("next_obs", demo.next_obs)):
        for name, rows in seen.items():
            group.create_dataset(f"{folder}/{name}", data=rows)


def _write_masks(file: Any, count: int, valid_fraction: float, seed: int) -> int:
    """Split the episodes; at least one stays for training. How many train."""
    order = np.random.default_rng(seed).permutation(count)
    valid = min(count - 1, round(valid_fraction * count))
    for name, members in (("valid", order[:valid]), ("train", order[valid:])):
        names = np.array([f"demo_{at + 1}" for at in sorted(members)], dtype="S")
        if len(names):
            file.create_dataset(f"mask/{name}", data=names)
    return count - valid


def _world_of_episode(episode: Episode) -> dict[str, Any]:
    about = episode.metadata
    return {key: getattr(about, key) for key in ("task", "robot", "controller", "control_hz")}


def _world_of_frames(frames: EpisodeFrames) -> dict[str, Any]:
    keys = ("task", "robot", "controller")
    return {key: frames.about.get(key, "") for key in keys} | {"control_hz": frames.about.get("control_hz", frames.fps)}


def _env_args(world: Mapping[str, Any]) -> dict[str, Any]:
    """How robomimic makes the environment; only a name where it is none of robosuite's."""
    task, name = world["task"], world["robot"]
    if task not in TASKS or name not in robot_names():
        return {"env_name": task or "unknown", "type": GYM, "env_kwargs": {}}
    robot = load_robot(name)
    robot = replace(robot, controller=world["controller"] or robot.controller)
    options = {
        "robots": robots_of(load_task(task), robot),
        "controller_configs": controller_configs(robot),
        "control_freq": world["control_hz"],
        "has_renderer": False,
        "has_offscreen_renderer": False,
        "use_object_obs": True,
        "use_camera_obs": False,
        "ignore_done": True,
    }
    return {"env_name": task, "env_version": versions()["robosuite"], "type": ROBOSUITE, "env_kwargs": options}
