"""Writes an episode that is at hand as a recording: what `read_episode` gives back."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lfd.core.channels import IMAGE, channel
from lfd.core.episode import Episode
from lfd.core.errors import EpisodeError
from lfd.core.protocols import WorldState
from lfd.record import cdr
from lfd.record.episode_file import END, write_about
from lfd.record.mcap_writing import McapWriter
from lfd.record.messages import step_messages

AT_ONCE = 16
"""Steps that are packed together."""


def write_episode(path: Path, episode: Episode) -> None:
    """Write an episode to the file `path`, which appears when it is whole.

    Raises `EpisodeError` when the episode has no simulation states, `OutputError` when the place cannot be written.
    """
    if episode.sim_states is None:
        raise EpisodeError("an episode without simulation states cannot be written as a recording")
    writer = McapWriter(path)
    try:
        _write(writer, episode, episode.sim_states)
        writer.finish()
    except BaseException:
        writer.discard()
        raise


def _write(writer: McapWriter, episode: Episode, sim_states: np.ndarray) -> None:
    about, labels = episode.metadata, episode.labels
    start_ns = _nanoseconds(about.started)
    has_expert = episode.expert_actions is not None
    made = step_messages(tuple(labels.items()), sim_states.shape[1], has_expert=has_expert, signals=())
    for message in made.all:
        writer.channel(message.topic, message.schema, message.about)
    topics = {camera: channel(f"{camera}_picture").topic for camera in episode.pictures}
    for camera, topic in topics.items():
        writer.channel(topic, IMAGE, {"unit": "1/255", "frame": camera})
    writer.channel("/task", "std_msgs/msg/String", {})
    memory = episode.start_memory
    state = WorldState(model_xml=episode.model_xml, sim=sim_states[0], memory=memory or {})
    write_about(writer, about, labels, state if episode.model_xml else None, start_ns)
    writer.message("/task", start_ns, cdr.pack_string(about.instruction))
    block = made.block(tuple(writer.number(message.topic) for message in made.all))
    seen = np.concatenate([*(episode.observations[name] for name in labels if name != "action"), sim_states], axis=1)
    done = np.arange(len(episode)) == len(episode) - 1
    followed = np.stack([episode.rewards, episode.successes, done, episode.interventions], axis=1).astype(float)
    decided = [episode.actions] if episode.expert_actions is None else [episode.actions, episode.expert_actions]
    rows = np.concatenate([seen[1:], followed, *decided], axis=1)[:, made.places]
    stamps = [start_ns + round(t * 1e9) for t in episode.times]
    for message in made.late[1:]:
        writer.message(message.topic, stamps[0], message.pack(stamps[0], seen[0][message.places]))
    for camera, topic in topics.items():
        writer.message(topic, stamps[0], cdr.pack_image(stamps[0], camera, episode.pictures[camera][0]))
    for begin in range(0, len(rows), AT_ONCE):
        some = rows[begin : begin + AT_ONCE]
        times = np.array([stamps[begin : begin + len(some)], stamps[begin + 1 : begin + 1 + len(some)]]).T
        writer.records(block.fill(some, times))
        for step in range(begin, begin + len(some)):
            for camera, topic in topics.items():
                picture = cdr.pack_image(stamps[step + 1], camera, episode.pictures[camera][step + 1])
                writer.message(topic, stamps[step + 1], picture)
    reward = float(episode.rewards.sum())
    facts = {"steps": len(episode), "success": episode.success, "reward": reward, "failure": ""}
    writer.metadata(END, {key: json.dumps(value) for key, value in facts.items()})


def _nanoseconds(started: str) -> int:
    """Nanoseconds since 1970 of an ISO 8601 time; now, where it is none."""
    try:
        when = datetime.fromisoformat(started)
    except ValueError:
        when = datetime.now(UTC)
    return round(when.timestamp() * 1e6) * 1000
