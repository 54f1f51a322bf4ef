"""What a replay shows, whatever it comes from: curves over time, and the motion of a model."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.core.channels import channel
from lfd.core.episode import Episode, Signal
from lfd.core.errors import DatasetError, InputError, UnknownName
from lfd.data.frames import load_frames
from lfd.record.episode_file import read_episode, recording_in
from lfd.worlds.cameras import load_model

PATH = "_path"
"""What channels end in that are ways of the gripper."""


@dataclass(frozen=True)
class Curve:
    """Values of a channel over time."""

    values: Float[np.ndarray, "N D"]
    names: tuple[str, ...]
    unit: str
    times: Float[np.ndarray, "N"] | None = None
    """Where it has times of its own [s]; else the clip's."""


@dataclass(frozen=True)
class Arrow:
    """A force over time: where it acts, and what it is."""

    origins: Float[np.ndarray, "N 3"]
    """[m]"""
    forces: Float[np.ndarray, "N 3"]
    """[N]"""


@dataclass(frozen=True)
class Clip:
    """One episode, ready to be shown."""

    title: str
    times: Float[np.ndarray, "N"]
    """Time of each row since the first [s]."""
    curves: Mapping[str, Curve]
    """Rerun path to the curve."""
    positions: Mapping[str, Float[np.ndarray, "N 3"]]
    """Name to a path in the world frame [m]."""
    model: mujoco.MjModel | None
    qpos: Float[np.ndarray, "N nq"] | None
    pictures: Mapping[str, tuple[bytes, ...]] = field(default_factory=dict)
    """Rerun path to the PNG of each row."""
    arrows: Mapping[str, Arrow] = field(default_factory=dict)
    """Name to a force at each row."""
    plans: Mapping[str, tuple[tuple[float, Float[np.ndarray, "P 3"]], ...]] = field(default_factory=dict)
    """Name to ways of the gripper [m], each from the time on at which it was planned [s]."""


def clip_of(source: Path, episode: int) -> Clip:
    """The clip of a recording, of a folder of recordings, of an evaluation, or of a LeRobot dataset.

    Raises `InputError` when `source` is none of these or has no such episode.
    """
    if not source.exists():
        raise InputError(f"nothing at {source}; give a recording, a dataset folder or an evaluation folder")
    if (source / "meta" / "info.json").is_file():
        return _clip_of_dataset(source, episode)
    path = recording_in(source, episode)
    return _clip_of_episode(read_episode(path), path.name)


def _clip_of_episode(episode: Episode, title: str) -> Clip:
    def held(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[-1:]]).reshape(len(values) + 1, -1)  # the last observation ends it

    curves = dict(_curve(name, values, episode.labels[name]) for name, values in episode.observations.items())
    actions = {"action": episode.actions, "expert_action": episode.expert_actions}
    curves |= dict(_curve(n, held(v), episode.labels["action"]) for n, v in actions.items() if v is not None)
    flags = {"reward": episode.rewards, "success": episode.successes, "intervention": episode.interventions}
    curves |= dict(_curve(name, held(values.astype(float)), (name,)) for name, values in flags.items())
    positions = {n.removesuffix("_pos"): v for n, v in episode.observations.items() if v.shape[1] == 3}
    model = load_model(episode.model_xml)
    assert episode.sim_states is not None
    qpos = episode.sim_states[:, 1 : 1 + model.nq]  # mjSTATE_INTEGRATION begins with time, qpos
    pictures = {channel(f"{name}_picture").path: data for name, data in episode.pictures.items()}
    plans = {name: signal for name, signal in episode.signals.items() if name.endswith(PATH)}
    curves |= dict(_signal_curve(name, signal) for name, signal in episode.signals.items() if name not in plans)
    return Clip(
        title,
        episode.times,
        curves,
        positions,
        model,
        qpos,
        pictures,
        arrows=_arrows(episode),
        plans={
            name.removesuffix(PATH): tuple(
                (float(t), row.reshape(-1, 3)) for t, row in zip(signal.times, signal.values, strict=True)
            )
            for name, signal in plans.items()
        },
    )


def _signal_curve(name: str, signal: Signal) -> tuple[str, Curve]:
    path, curve = _curve(name, signal.values, signal.names)
    return path, replace(curve, times=signal.times)


def _arrows(episode: Episode) -> dict[str, Arrow]:
    """The force of a person who pushed, at the gripper."""
    signal, gripper = episode.signals.get("push"), episode.observations.get("ee_pos")
    if signal is None or gripper is None:
        return {}
    forces = np.zeros((len(episode.times), 3))
    forces[np.searchsorted(episode.times, signal.times - 1e-6)] = signal.values[:, :3]
    return {"push": Arrow(gripper, forces)}


def _clip_of_dataset(root: Path, episode: int) -> Clip:
    frames = load_frames(root)
    rows = (frames.episode_index == episode).numpy()
    if not rows.any():
        raise DatasetError(f"{root} has episodes 0 to {int(frames.episode_index.max())}, not {episode}")
    times = np.arange(rows.sum()) / frames.fps
    components: dict[str, dict[str, np.ndarray]] = {}
    for feature, values in frames.columns.items():
        for index, name in enumerate(frames.names[feature]):
            part, dot, label = name.rpartition(".")
            components.setdefault(part if dot else feature, {})[label] = values.numpy()[rows, index].astype(float)
    curves = dict(_curve(n, np.stack(list(v.values()), axis=1), tuple(v)) for n, v in components.items())
    positions = {
        name.removesuffix("_pos"): np.stack([values[axis] for axis in "xyz"], axis=1)
        for name, values in components.items()
        if name.endswith("_pos") and set(values) == set("xyz")
    }
    model = load_model((root / "model.xml").read_text()) if (root / "model.xml").is_file() else None
    qpos = _posture(model, components, len(times)) if model is not None else None
    return Clip(f"{root.name} episode {episode}", times, curves, positions, model, qpos)


def _curve(name: str, values: np.ndarray, names: tuple[str, ...]) -> tuple[str, Curve]:
    try:
        row = channel(name)
    except UnknownName:  # a dataset of another project names its features as it likes
        return f"plots/{name}", Curve(values, names, "")
    return row.path, Curve(values, names, row.unit)


def _posture(model: mujoco.MjModel, components: Mapping[str, Mapping[str, np.ndarray]], rows: int) -> np.ndarray:
    """Joint and object poses named in a dataset, as the model's qpos; what is not named stays where it is."""
    qpos = np.tile(model.qpos0, (rows, 1))
    joints = {model.joint(j).name: model.joint(j) for j in range(model.njnt)}
    for name, values in components.items():
        if name in ("joint_pos", "gripper_pos"):
            for joint, column in values.items():
                qpos[:, joints[joint].qposadr[0]] = column
        elif (body := name.removesuffix("_pos").removesuffix("_quat")) and f"{body}_joint0" in joints:
            at = joints[f"{body}_joint0"].qposadr[0]
            axes, offset = ("xyz", 0) if name.endswith("_pos") else ("wxyz", 3)
            for i, axis in enumerate(axes):
                qpos[:, at + offset + i] = values[axis]
    return qpos
