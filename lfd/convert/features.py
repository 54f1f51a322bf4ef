"""Which channels of an episode become which LeRobot features.

Any key that starts with `action` becomes an output of a LeRobot policy and any that starts with
`observation` an input, so nothing else may be called so.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lfd.convert.frames import EpisodeFrames, Pictures
from lfd.core.channels import CHANNELS, ENVIRONMENT_STATE, STATE, channel, observed, operands
from lfd.core.episode import Episode
from lfd.core.errors import DatasetError, RecipeError, UnknownName
from lfd.core.recipe import as_table
from lfd.record.png import decode_png

FLAGS = ("reward", "success", "done", "intervention")
CLOCK_TOLERANCE_S = 1e-4  # LeRobot's own


@dataclass(frozen=True, kw_only=True)
class ConvertRecipe:
    """The `[convert]` table of a file in `datasets/`."""

    state: tuple[str, ...]
    """Channels of the robot, in the order in which they make up observation.state."""
    environment_state: tuple[str, ...]
    """Channels of the objects, in the order in which they make up observation.environment_state; also differences of
    two channels, such as `cube_pos - ee_pos`, where a millimetre is not small beside the size of the workspace."""
    action: str
    """What becomes the action to imitate: `expert_action`, as the expert meant it, or `action`, as it was applied."""
    cameras: tuple[str, ...] = ()
    """Cameras whose pictures become observation.images.CAMERA."""
    failures: bool = True
    """Whether episodes that do not end in success are taken too."""

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
        if len(set(self.cameras)) != len(self.cameras):
            raise RecipeError(f"{where} cameras: a camera is listed twice: {', '.join(self.cameras)}")


def frames_of_episode(
    episode: Episode, recipe: ConvertRecipe, source: str, *, notes: Mapping[str, Any] | None = None
) -> EpisodeFrames:
    """The rows 0 to T - 1 of an episode: each action with the observation before it.

    Raises `DatasetError` for a channel or camera that the episode does not have, when the recipe wants the expert's
    actions and there are none, or when a time is off its step.
    """
    _check_clock(episode, source)
    try:
        return _frames(episode, recipe, source, notes or {})
    except UnknownName as error:
        raise DatasetError(f"{source}: {error}") from error


def pieces_of_episode(
    episode: Episode, recipe: ConvertRecipe, source: str, *, notes: Mapping[str, Any] | None = None
) -> list[EpisodeFrames]:
    """The episode, or the runs of steps in which an expert was asked, where its action is what is imitated.

    Raises what `frames_of_episode` does.
    """
    if recipe.action == "action" or episode.expert_actions is None or episode.labelled.all():
        return [frames_of_episode(episode, recipe, source, notes=notes)]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], episode.labelled, [False]]).astype(int)))
    filled = replace(episode, expert_actions=np.nan_to_num(episode.expert_actions))
    whole = frames_of_episode(filled, recipe, source, notes=notes)
    return [_piece(whole, begin, end) for begin, end in edges.reshape(-1, 2).tolist()]


def _piece(frames: EpisodeFrames, begin: int, end: int) -> EpisodeFrames:
    return replace(
        frames,
        source=f"{frames.source} from step {begin}",
        columns={name: rows[begin:end] for name, rows in frames.columns.items()},
        pictures={name: Pictures(p.items[begin:end], p.decode) for name, p in frames.pictures.items()},
        notes={**frames.notes, "start_s": begin / frames.fps},
    )


def _frames(episode: Episode, recipe: ConvertRecipe, source: str, notes: Mapping[str, Any]) -> EpisodeFrames:
    action = CHANNELS["action"]
    actions = episode.actions if recipe.action == "action" else episode.expert_actions
    if actions is None:
        raise DatasetError(
            f'{source}: no expert was asked in this episode; set `action = "action"` in the recipe\'s [convert]'
        )
    columns: dict[str, np.ndarray] = {}
    names: dict[str, tuple[str, ...]] = {}
    units: dict[str, tuple[str, ...]] = {}
    for feature, channels in ((STATE, recipe.state), (ENVIRONMENT_STATE, recipe.environment_state)):
        if channels or feature == STATE:
            names[feature], units[feature] = _components(episode, channels)
            rows = [observed(episode.observations, name)[:-1] for name in channels]
            columns[feature] = np.concatenate(rows, axis=1).astype(np.float32)
    columns["action"] = actions.astype(np.float32)
    names["action"] = episode.labels["action"]
    units["action"] = (action.unit,) * len(names["action"])
    done = np.arange(len(episode)) == len(episode) - 1
    flags = (episode.rewards.astype(np.float32), episode.successes, done, episode.interventions)
    for name, values in zip(FLAGS, flags, strict=True):
        row = CHANNELS[name]
        assert row.feature is not None
        columns[row.feature], names[row.feature], units[row.feature] = values[:, None], (name,), (row.unit,)
    about = episode.metadata
    said = {"recovered": about.recovered} if about.recovered else {}
    return EpisodeFrames(
        source=source,
        fps=about.control_hz,
        task=about.instruction,
        columns=columns,
        names=names,
        units=units,
        pictures={channel(f"{name}_picture").feature or "": _pictures(episode, name) for name in recipe.cameras},
        about={
            "robot": about.robot,
            "controller": about.controller,
            "task": about.task,
            "control_hz": about.control_hz,
        },
        notes={**said, **notes},
        recipe={**about.recipe, "convert": as_table(recipe)},
        model_xml=episode.model_xml,
    )


def _components(episode: Episode, channels: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the components of joined channels, such as `ee_pos.x`, and their units."""
    for name in (part for each in channels for part in operands(each)):
        if name not in episode.labels:
            raise UnknownName("channel", name, episode.labels)
    labels = [(name, label) for name in channels for label in episode.labels[operands(name)[0]]]
    return tuple(f"{name}.{label}" for name, label in labels), tuple(channel(name).unit for name, _ in labels)


def _pictures(episode: Episode, camera: str) -> Pictures:
    if camera not in episode.pictures:
        raise UnknownName("camera", camera, episode.pictures, "A recipe's [record] cameras says what is recorded.")
    return Pictures(episode.pictures[camera][:-1], decode_png)


def _check_clock(episode: Episode, source: str) -> None:
    hz = episode.metadata.control_hz
    late = np.abs(episode.times - np.arange(len(episode) + 1) / hz)
    if late.max() > CLOCK_TOLERANCE_S:
        at = int(late.argmax())
        raise DatasetError(
            f"{source}: the observation of step {at} stands at {episode.times[at]:.4f} s, {hz} Hz puts it at "
            f"{at / hz:.4f} s"
        )
