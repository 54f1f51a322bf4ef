"""Episodes and dataset rows as demonstrations of robomimic.

robomimic has T rows of obs, action, reward, done and next_obs; next_obs of row t is the observation after it. Names
are robosuite's, quaternions x y z w.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from lfd.convert.frames import EpisodeFrames
from lfd.convert.hdf5.recorded_model import skeleton
from lfd.core.channels import CHANNELS, ENVIRONMENT_STATE, STATE, WXYZ, channel
from lfd.core.episode import Episode
from lfd.core.rotations import xyzw_from_wxyz
from lfd.record.png import decode_png
from lfd.worlds.robosuite_observing import robosuite_observations

OBJECT = "object"
"""All that robomimic's configurations take of the objects."""
NAMES = {
    "joint_pos": "joint_pos",
    "joint_vel": "joint_vel",
    "joint_effort": "joint_effort",
    "gripper_pos": "gripper_qpos",
    "gripper_vel": "gripper_qvel",
    "gripper_effort": "gripper_effort",
    "ee_pos": "eef_pos",
    "ee_quat": "eef_quat_site",
}
"""Channels of a robot to robosuite's names, `robot0_` before them. robosuite's `eef_quat` is the hand's body's."""


@dataclass(frozen=True, kw_only=True)
class RobomimicDemo:
    """T rows as robomimic keeps them."""

    actions: Shaped[np.ndarray, "T Da"]
    rewards: Float[np.ndarray, "T"]
    dones: Shaped[np.ndarray, "T"]
    """1 in the last row."""
    states: Float[np.ndarray, "T _"] | None
    """Time [s], qpos, qvel before each action."""
    obs: Mapping[str, Shaped[np.ndarray, "T *_"]]
    next_obs: Mapping[str, Shaped[np.ndarray, "T *_"]]
    model_xml: str


def demo_of_episode(episode: Episode) -> RobomimicDemo:
    """A recording; with simulator states, what robosuite observes in them, and beside it what only lfd records."""
    objects = [name for name in episode.observations if channel(name).feature == ENVIRONMENT_STATE]
    seen = _renamed(episode.observations, episode.labels, objects)
    states = None
    if episode.sim_states is not None:
        model = skeleton(episode.model_xml).model
        states = episode.sim_states[:, : 1 + model.nq + model.nv]  # mjSTATE_INTEGRATION begins with them
        theirs = _robosuites(episode, states)
        seen |= {name: rows for name, rows in theirs.items() if not name.endswith("-state")}
        seen[OBJECT] = theirs["object-state"]
    for camera, pictures in episode.pictures.items():
        seen[f"{camera}_image"] = np.stack([decode_png(data) for data in pictures])
    last = np.arange(len(episode)) == len(episode) - 1
    return RobomimicDemo(
        actions=episode.actions,
        rewards=episode.rewards,
        dones=last.astype(np.int64),
        states=None if states is None else states[:-1],
        obs={name: rows[:-1] for name, rows in seen.items()},
        next_obs={name: rows[1:] for name, rows in seen.items()},
        model_xml=episode.model_xml,
    )


def demo_of_frames(frames: EpisodeFrames) -> RobomimicDemo:
    """Rows of a dataset. They have no row T: the last next_obs is the last observation."""
    channels: dict[str, np.ndarray] = {}
    labels: dict[str, tuple[str, ...]] = {}
    objects = []
    for feature in (STATE, ENVIRONMENT_STATE):
        for name, columns in _by_channel(frames, feature).items():
            channels[name] = frames.columns[feature][:, columns]
            labels[name] = tuple(frames.names[feature][at].partition(".")[2] for at in columns)
            objects += [name] * (feature == ENVIRONMENT_STATE)
    seen = _renamed(channels, labels, objects)
    for feature, pictures in frames.pictures.items():
        seen[f"{feature.rpartition('.')[2]}_image"] = np.stack(list(pictures))
    count = len(frames)
    after = np.minimum(np.arange(count) + 1, count - 1)
    ends = _flag(frames, "done", np.arange(count) == count - 1)
    return RobomimicDemo(
        actions=frames.columns["action"],
        rewards=_flag(frames, "reward", np.zeros(count)).astype(np.float64),
        dones=ends.astype(np.int64),
        states=None,
        obs=seen,
        next_obs={name: rows[after] for name, rows in seen.items()},
        model_xml=frames.model_xml,
    )


def _robosuites(episode: Episode, states: np.ndarray) -> Mapping[str, np.ndarray]:
    about = episode.metadata
    return robosuite_observations(
        task=about.task,
        robot=about.robot,
        controller=about.controller,
        control_hz=about.control_hz,
        model_xml=episode.model_xml,
        states=states,
    )


def _by_channel(frames: EpisodeFrames, feature: str) -> dict[str, list[int]]:
    """Channel to its columns in a feature, by component names such as `ee_pos.x`; without names, the feature's."""
    found: dict[str, list[int]] = {}
    for at, name in enumerate(frames.names.get(feature, ())):
        begin, dot, _ = name.partition(".")
        found.setdefault(begin if dot else feature.rpartition(".")[2], []).append(at)
    return found


def _flag(frames: EpisodeFrames, name: str, otherwise: np.ndarray) -> np.ndarray:
    feature = CHANNELS[name].feature or ""
    return frames.columns[feature][:, 0] if feature in frames.columns else otherwise


def _renamed(
    channels: Mapping[str, np.ndarray], labels: Mapping[str, tuple[str, ...]], objects: Collection[str]
) -> dict[str, np.ndarray]:
    """Channels by robosuite's names, and those of `objects` once more as one array."""
    seen: dict[str, np.ndarray] = {}
    turned = {
        name: xyzw_from_wxyz(rows) if labels.get(name) == WXYZ else np.asarray(rows) for name, rows in channels.items()
    }
    for name, rows in turned.items():
        for key, columns in _keys(name, labels.get(name, ())).items():
            seen[key] = rows[:, columns]
    if objects:
        seen[OBJECT] = np.concatenate([turned[name] for name in objects], axis=1)
    return seen


def _keys(name: str, labels: tuple[str, ...]) -> dict[str, Any]:
    """robosuite's names of a channel and their columns: joints of two robots are two arrays there."""
    everything = slice(None)
    if name in NAMES and not name.startswith("ee_"):
        owners = [found[1] if (found := re.match(r"(?:robot|gripper)(\d+)_", label)) else "0" for label in labels]
        return {
            f"robot{owner}_{NAMES[name]}": [at for at, of in enumerate(owners) if of == owner]
            for owner in dict.fromkeys(owners)
        }
    for hand in ("ee_pos", "ee_quat"):
        if name == hand:
            return {f"robot0_{NAMES[hand]}": everything}
        if name.endswith(f"_{hand}"):  # robot1_ee_pos, or left_ee_pos of a robot with two arms
            arm = name.removesuffix(hand)
            return {f"{arm if arm.startswith('robot') else f'robot0_{arm}'}{NAMES[hand]}": everything}
    return {name: everything}
