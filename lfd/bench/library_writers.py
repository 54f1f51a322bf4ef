"""The same messages written by other libraries: mcap's own writer, and foxglove-sdk's, which is in Rust.

Both get messages one by one, each packed when its step comes, as a recorder without blocks would do it.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from lfd.core.episode import Episode
from lfd.record.cdr import schema_text
from lfd.record.messages import StepMessages, step_messages

Messages = Iterator[tuple[int, str, bytes]]
"""Log time [ns], topic, data."""
START_NS = 1_700_000_000 * 10**9
FLUSH_NS = 500_000_000


def step_by_step(episode: Episode) -> tuple[Mapping[str, str], Messages]:
    """Topic to message type, and the messages of an episode, packed one by one."""
    assert episode.sim_states is not None
    made = step_messages(tuple(episode.labels.items()), episode.sim_states.shape[1], has_expert=False, signals=())
    return {message.topic: message.schema for message in made.all}, _packed(episode, episode.sim_states, made)


def _packed(episode: Episode, sim_states: np.ndarray, made: StepMessages) -> Messages:
    seen = [rows for name in episode.labels if name != "action" for rows in [episode.observations[name]]]
    flags = np.stack([episode.rewards, episode.successes, episode.successes, episode.interventions], axis=1)
    for step in range(len(episode)):
        parts = [*(rows[step + 1] for rows in seen), sim_states[step + 1], flags[step], episode.actions[step]]
        numbers = np.concatenate(parts)
        for messages, at in ((made.early, step), (made.late, step + 1)):
            stamp = START_NS + round(episode.times[at] * 1e9)
            for message in messages:
                yield stamp, message.topic, message.pack(stamp, numbers[message.places])


def write_with_mcap(path: Path, schemas: Mapping[str, str], messages: Messages) -> None:
    """mcap's writer, with chunks of 256 KiB, flushed every half second of the episode."""
    from lfd.record.mcap_writing import library_writer

    with path.open("wb") as stream:
        writer = library_writer(stream)
        writer.start(profile="ros2", library="bench")
        channels = {}
        for topic, schema in schemas.items():
            number = writer.register_schema(schema, "ros2msg", schema_text(schema).encode())
            channels[topic] = writer.register_channel(topic, "cdr", number)
        flushed = 0
        for stamp, topic, data in messages:
            writer.add_message(channels[topic], stamp, data, stamp)
            if stamp - flushed > FLUSH_NS:
                writer.flush()
                flushed = stamp
        writer.finish()


def write_with_foxglove(path: Path, schemas: Mapping[str, str], messages: Messages) -> None:
    """foxglove-sdk, with chunks of 256 KiB, flushed every half second of the episode."""
    import foxglove
    from foxglove.mcap import MCAPWriteOptions

    context = foxglove.Context()
    options = MCAPWriteOptions(chunk_size=256 * 1024, profile="ros2", compression_threads=0)
    with foxglove.open_mcap(path, context=context, writer_options=options, allow_overwrite=True) as writer:
        flushed = 0
        channels = {}
        for topic, schema in schemas.items():
            described = foxglove.Schema(name=schema, encoding="ros2msg", data=schema_text(schema).encode())
            channels[topic] = foxglove.Channel(topic, schema=described, message_encoding="cdr", context=context)
        for stamp, topic, data in messages:
            channels[topic].log(data, log_time=stamp)
            if stamp - flushed > FLUSH_NS:
                writer.flush()
                flushed = stamp


WRITERS: dict[str, Callable[[Path, Mapping[str, str], Messages], None]] = {
    "mcap": write_with_mcap,
    "foxglove-sdk": write_with_foxglove,
}
"""Name to writer."""
