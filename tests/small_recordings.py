"""Recordings of a few steps for tests: parts of one recorded episode, changed and written again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lfd.convert.sources import SourceRecipe
from lfd.core.episode import Episode
from lfd.record.episode_writing import write_episode
from lfd.record.png import encode_png

CAMERA, FEATURE = "agentview", "observation.images.agentview"
CONVERT: dict[str, Any] = {
    "state": ["joint_pos", "ee_pos", "ee_quat"],
    "environment_state": ["cube_pos"],
    "action": "action",
}


def recipe(*, video: dict[str, Any] | None = None, **convert: Any) -> SourceRecipe:
    """A recipe for the recordings of this module."""
    tables = {"convert": CONVERT | convert} | ({} if video is None else {"video": video})
    return SourceRecipe(where="the test's recipe", tables=tables)


def toml(path: Path, codec: str = "", **convert: Any) -> Path:
    """The same as a file."""
    lines = ["[convert]", *(f"{key} = {json.dumps(value)}" for key, value in (CONVERT | convert).items())]
    path.write_text("\n".join(lines) + (f'\n[video]\ncodec = "{codec}"\n' if codec else "\n"))
    return path


def part(episode: Episode, begin: int, end: int, **about: Any) -> Episode:
    """The steps from `begin` to `end` of an episode."""
    rows, seen = slice(begin, end), slice(begin, end + 1)
    assert episode.sim_states is not None
    return replace(
        episode,
        times=episode.times[seen] - episode.times[begin],
        observations={name: values[seen] for name, values in episode.observations.items()},
        actions=episode.actions[rows],
        rewards=episode.rewards[rows],
        successes=episode.successes[rows],
        interventions=episode.interventions[rows],
        sim_states=episode.sim_states[seen],
        pictures={name: pictures[seen] for name, pictures in episode.pictures.items()},
        metadata=replace(episode.metadata, **about),
        declared=None,
    )


def filmed(episode: Episode, height: int = 64, width: int = 96) -> Episode:
    """The episode with the pictures of a camera that sees a disc move over a gradient."""
    y, x = np.mgrid[:height, :width]
    ground = np.stack([120 * x / width, 120 * y / height, 60 + 0 * x], axis=-1)
    pictures = []
    for t in range(len(episode) + 1):
        middle = height / 2 + height / 4 * np.sin(t / 4), width * (t + 1) / (len(episode) + 2)
        disc = (y - middle[0]) ** 2 + (x - middle[1]) ** 2 < (height / 6) ** 2
        pictures.append(encode_png(np.where(disc[..., None], (210, 200, 170), ground).astype(np.uint8)))
    return replace(episode, pictures={CAMERA: tuple(pictures)})


def write_all(folder: Path, *episodes: Episode, first: int = 0) -> list[Path]:
    """A folder of recordings."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"episode_{index:06d}.mcap" for index in range(first, first + len(episodes))]
    for path, episode in zip(paths, episodes, strict=True):
        write_episode(path, episode)
    return paths
