"""What a replay shows, whatever it comes from: curves over time, states, pictures, and the motion of a model."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from lfd.core.channels import channel
from lfd.core.episode import Episode, EpisodeMetadata, Signal
from lfd.core.errors import InputError, UnknownName
from lfd.planning.signed_distances import Shape
from lfd.record.episode_file import read_episode, recording_in
from lfd.worlds.cameras import load_model

PATH = "_path"
"""What channels end in that are ways of the gripper."""
GRIPPERS = ("ee", "left_ee", "right_ee", "robot0_ee", "robot1_ee")
"""Names of the robot's own paths."""
SOLVED, UNSOLVED = "solved", "not solved"
EXPERT, POLICY = "expert or person", "policy"
WHO_ACTS, OVERRULED = "who acts", "overruled"
"""The lane that says so, and what paths end in where the policy did not."""
ShapesOf = Callable[[EpisodeMetadata], tuple[Shape, ...]]
"""What stands in the scene of an episode and is not in its model."""
KEPT_MODELS = 4
"""Compiled models that are kept: the episodes of a folder often share one."""


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
class Video:
    """The pictures of an episode as a film."""

    content: bytes
    """MP4."""
    frames: Int[np.ndarray, "N"]
    """Which of its frames, in the order in which they are shown, belongs to each row."""


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
    """Rerun path to the picture of each row, as PNG or JPEG."""
    arrows: Mapping[str, Arrow] = field(default_factory=dict)
    """Name to a force at each row."""
    plans: Mapping[str, tuple[tuple[float, Float[np.ndarray, "P 3"]], ...]] = field(default_factory=dict)
    """Name to ways of the gripper [m], each from the time on at which it was planned [s]."""
    videos: Mapping[str, Video] = field(default_factory=dict)
    """Rerun path to a film."""
    states: Mapping[str, tuple[tuple[float, str], ...]] = field(default_factory=dict)
    """Name, such as `who acts`, to what held from a time on [s]."""
    pieces: Mapping[str, tuple[Float[np.ndarray, "_ 3"], ...]] = field(default_factory=dict)
    """Name to parts of a path that stand out [m]."""
    success: bool | None = None
    """Whether it ended in success; None where nobody says so."""
    about: Mapping[str, str] = field(default_factory=dict)
    """Facts to be read beside it."""
    shapes: tuple[Shape, ...] = ()
    """What stands in the scene and is not in the model."""

    @property
    def name(self) -> str:
        """Title and outcome."""
        return self.title if self.success is None else f"{self.title}: {SOLVED if self.success else UNSOLVED}"


def clip_of(source: Path, episode: int) -> Clip:
    """The clip of a recording, of a folder of recordings, of an evaluation, or of a LeRobot dataset.

    Raises `InputError` when `source` is none of these or has no such episode.
    """
    from lfd.replay.dataset_clip import dataset_clip, is_dataset

    if not source.exists():
        raise InputError(f"nothing at {source}; give a recording, a dataset folder or an evaluation folder")
    if is_dataset(source):
        return dataset_clip(source, episode)
    return recording_clip(recording_in(source, episode))


def no_shapes(told: EpisodeMetadata) -> tuple[Shape, ...]:
    """Nothing stands in the scene beside what the model has."""
    del told
    return ()


def recording_clip(path: Path, shapes_of: ShapesOf = no_shapes) -> Clip:
    """The clip of a recording, with what stands in its scene.

    Raises `RecordingError` for a file that cannot be read.
    """
    episode = read_episode(path)
    return replace(episode_clip(episode, path.name), shapes=shapes_of(episode.metadata))


@lru_cache(maxsize=KEPT_MODELS)
def kept_model(model_xml: str) -> mujoco.MjModel:
    """A compiled model; nobody may change it."""
    return load_model(model_xml)


def episode_clip(episode: Episode, title: str) -> Clip:
    """The clip of an episode that is in memory."""

    def held(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[-1:]]).reshape(len(values) + 1, -1)  # the last observation ends it

    curves = dict(named_curve(name, values, episode.labels[name]) for name, values in episode.observations.items())
    actions = {"action": episode.actions, "expert_action": episode.expert_actions}
    curves |= dict(named_curve(n, held(v), episode.labels["action"]) for n, v in actions.items() if v is not None)
    flags = {"reward": episode.rewards, "success": episode.successes, "intervention": episode.interventions}
    curves |= dict(named_curve(name, held(values.astype(float)), (name,)) for name, values in flags.items())
    positions = {n.removesuffix("_pos"): v for n, v in episode.observations.items() if v.shape[1] == 3}
    model = kept_model(episode.model_xml)
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
        states=states_of(episode.times, _told_of_task(episode), episode.interventions),
        pieces=expert_pieces(positions, episode.interventions),
        success=episode.success,
        about=_about(episode),
    )


def _about(episode: Episode) -> dict[str, str]:
    told = episode.metadata
    facts = {
        "task": f"{told.task}: {told.instruction}",
        "robot": f"{told.robot}, {told.controller} at {told.control_hz} Hz",
        "policy": told.policy,
        "made for": f"{told.stage}, seed {told.seed}, number {told.index}",
        "length": f"{len(episode)} steps, {episode.times[-1]:.2f} s",
        "outcome": SOLVED if episode.success else UNSOLVED,
        "started": told.started,
    }
    if episode.interventions.any():
        facts["expert"] = f"acted in {int(episode.interventions.sum())} of {len(episode)} steps"
    return facts | ({"recovered": told.recovered} if told.recovered else {})


def _told_of_task(episode: Episode) -> Bool[np.ndarray, "T"] | None:
    """Whether the simulation's task was solved after each step; None where success was something else."""
    return episode.successes if bool(episode.successes[-1]) == episode.success else None


def states_of(
    times: Float[np.ndarray, "N"], solved: Bool[np.ndarray, "T"] | None, overruled: Bool[np.ndarray, "T"] | None
) -> dict[str, tuple[tuple[float, str], ...]]:
    """Lanes of an episode: whether the task is solved after each of T steps if that is known, and who chose them if
    anybody overruled the policy.

    There are T + 1 times in recordings, T in datasets, where the last outcome is not shown any more.
    """
    lanes = {}
    if solved is not None:
        after = np.concatenate([[False], solved])[: len(times)]
        lanes["task"] = _changes(times, after, SOLVED, UNSOLVED)
    if overruled is not None and overruled.any():
        lanes[WHO_ACTS] = _changes(times, overruled, EXPERT, POLICY)
    return lanes


def _changes(times: np.ndarray, flags: np.ndarray, yes: str, no: str) -> tuple[tuple[float, str], ...]:
    """Where a flag changes, and to what."""
    rows = np.flatnonzero(np.diff(flags.astype(int), prepend=-1))
    return tuple((float(times[row]), yes if flags[row] else no) for row in rows)


def expert_pieces(
    positions: Mapping[str, Float[np.ndarray, "N 3"]], overruled: Bool[np.ndarray, "T"]
) -> dict[str, tuple[Float[np.ndarray, "_ 3"], ...]]:
    """The parts of the gripper's paths on which somebody overruled the policy."""
    edges = np.flatnonzero(np.diff(overruled.astype(int), prepend=0, append=0)).reshape(-1, 2)
    if not len(edges):
        return {}
    return {
        f"{name}_{OVERRULED}": tuple(path[begin : end + 1] for begin, end in edges)
        for name, path in positions.items()
        if name in GRIPPERS
    }


def _signal_curve(name: str, signal: Signal) -> tuple[str, Curve]:
    path, curve = named_curve(name, signal.values, signal.names)
    return path, replace(curve, times=signal.times)


def _arrows(episode: Episode) -> dict[str, Arrow]:
    """The force of a person who pushed, at the gripper."""
    signal, gripper = episode.signals.get("push"), episode.observations.get("ee_pos")
    if signal is None or gripper is None:
        return {}
    forces = np.zeros((len(episode.times), 3))
    forces[np.searchsorted(episode.times, signal.times - 1e-6)] = signal.values[:, :3]
    return {"push": Arrow(gripper, forces)}


def entity(name: str) -> str:
    """A name as one part of a Rerun path."""
    return re.sub(r"[^\w.\-]", "_", name)


def named_curve(name: str, values: Float[np.ndarray, "N D"], names: tuple[str, ...]) -> tuple[str, Curve]:
    """Rerun path and curve of a channel; a name that no channel has is shown as it is."""
    try:
        row = channel(name)
    except UnknownName:  # a dataset of another project names its features as it likes
        return f"plots/{entity(name)}", Curve(values, names, "")
    return "/".join(map(entity, row.path.split("/"))), Curve(values, names, row.unit)
