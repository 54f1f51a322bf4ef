"""Which channels of an episode become which LeRobot features.

Any key that starts with `action` becomes an output of a LeRobot policy and any that starts with
`observation` an input, so nothing else may be called so.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfd.core.channels import CHANNELS, ENVIRONMENT_STATE, STATE, channel
from lfd.core.episode import Episode
from lfd.core.errors import DatasetError, RecipeError, UnknownName
from lfd.record.png import decode_png

FLAGS = ("reward", "success", "done", "intervention")


@dataclass(frozen=True, kw_only=True)
class ConvertRecipe:
    """The `[convert]` table of a file in `datasets/`."""

    state: tuple[str, ...]
    """Channels of the robot, in the order in which they make up observation.state."""
    environment_state: tuple[str, ...]
    """Channels of the objects, in the order in which they make up observation.environment_state."""
    action: str
    """What becomes the action to imitate: `expert_action`, as the expert meant it, or `action`, as it was applied."""
    cameras: tuple[str, ...] = ()
    """Cameras whose pictures become observation.images.CAMERA, without loss."""

    def check(self, where: str) -> None:
        if self.action not in ("action", "expert_action"):
            raise UnknownName(f"action in {where}:", self.action, ("action", "expert_action"))
        for key, feature in (("state", STATE), ("environment_state", ENVIRONMENT_STATE)):
            names = getattr(self, key)
            for name in names:
                if channel(name).feature != feature:
                    raise RecipeError(f"{where} {key}: channel {name!r} does not belong to {feature}")
            if len(set(names)) != len(names):
                raise RecipeError(f"{where} {key}: a channel is listed twice: {', '.join(names)}")


def component_names(episode: Episode, channels: tuple[str, ...]) -> list[str]:
    """Names of the components of joined channels, such as `ee_pos.x`.

    Raises `UnknownName` for a channel that the episode does not have.
    """
    for name in channels:
        if name not in episode.labels:
            raise UnknownName("channel", name, episode.labels)
    return [f"{name}.{label}" for name in channels for label in episode.labels[name]]


def features_of(episode: Episode, recipe: ConvertRecipe) -> dict[str, dict[str, Any]]:
    """LeRobot's description of the features that the recipe makes of an episode."""

    def vector(names: list[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": (len(names),), "names": names}

    features = {STATE: vector(component_names(episode, recipe.state))}
    if recipe.environment_state:
        features[ENVIRONMENT_STATE] = vector(component_names(episode, recipe.environment_state))
    features["action"] = vector(list(episode.labels["action"]))
    for name in recipe.cameras:
        if name not in episode.pictures:
            raise UnknownName("camera", name, episode.pictures, "A recipe's [record] cameras says what is recorded.")
        shape = decode_png(episode.pictures[name][0]).shape
        features[_picture(name)] = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
    for name in FLAGS:
        kind = "float32" if name == "reward" else "bool"
        features[_key(name)] = {"dtype": kind, "shape": (1,), "names": None}
    return features


def columns_of(episode: Episode, recipe: ConvertRecipe) -> Mapping[str, np.ndarray]:
    """The T rows of each feature.

    Raises `DatasetError` when the recipe wants the expert's actions and the episode has none.
    """

    def joined(channels: tuple[str, ...]) -> np.ndarray:
        return np.concatenate([episode.observations[name][:-1] for name in channels], axis=1).astype(np.float32)

    actions = episode.actions if recipe.action == "action" else episode.expert_actions
    if actions is None:
        raise DatasetError('no expert was asked in this episode; set `action = "action"` in the recipe\'s [convert]')
    columns = {STATE: joined(recipe.state)}
    if recipe.environment_state:
        columns[ENVIRONMENT_STATE] = joined(recipe.environment_state)
    for name in recipe.cameras:
        columns[_picture(name)] = np.stack([decode_png(data) for data in episode.pictures[name][:-1]])
    columns["action"] = actions.astype(np.float32)
    done = np.arange(len(episode)) == len(episode) - 1
    flags = (episode.rewards.astype(np.float32), episode.successes, done, episode.interventions)
    return columns | {_key(name): values[:, None] for name, values in zip(FLAGS, flags, strict=True)}


def _picture(camera: str) -> str:
    return channel(f"{camera}_picture").feature or ""


def _key(name: str) -> str:
    feature = CHANNELS[name].feature
    assert feature is not None
    return feature
