"""MCAP files of one episode. The only module that imports mcap.

A file is written under a `.part` name and renamed when it is closed, so that a finished name always means a
whole file. Chunks are flushed every half second: what a crash can lose.
"""

import os
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer
from zstandard import ZstdError

from lfd.core.artifact import UNWRITABLE
from lfd.core.errors import OutputError, RecordingError
from lfd.record.cdr import schema_text

SUFFIX = ".mcap"
CHUNK_BYTES = 256 * 1024
FLUSH_S = 0.5
DAMAGE = (McapError, ZstdError, struct.error, ValueError, KeyError, OverflowError, EOFError, AssertionError)
"""What reading a damaged file can raise; UnicodeDecodeError is a ValueError."""


class McapWriter:
    """Writes ROS 2 messages to a file that appears under its name when finished.

    Raises `OutputError` when the disk is full or the folder cannot be written; what was finished before stays.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._part = path.with_name(path.name + ".part")
        try:
            self._stream = self._part.open("wb")
        except OSError as error:
            raise OutputError(f"cannot write {self._part}: {error.strerror}; choose another --out") from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="ros2", library="lfd")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._flushed = time.monotonic()

    def channel(self, topic: str, message_type: str, about: Mapping[str, str]) -> None:
        """Announce a topic; `about` says unit and frame."""
        if message_type not in self._schemas:
            definition = schema_text(message_type).encode()
            self._schemas[message_type] = self._writer.register_schema(message_type, "ros2msg", definition)
        self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[message_type], dict(about))

    def message(self, topic: str, time_ns: int, data: bytes) -> None:
        with self._writing():
            self._writer.add_message(self._channels[topic], time_ns, data, time_ns)
            if time.monotonic() - self._flushed > FLUSH_S:
                self._writer.flush()
                self._flushed = time.monotonic()

    def metadata(self, name: str, content: Mapping[str, str]) -> None:
        with self._writing():
            self._writer.add_metadata(name, dict(content))

    def attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        with self._writing():
            self._writer.add_attachment(time_ns, time_ns, name, media_type, data)

    def finish(self) -> None:
        """Close the file, make sure that it is on the disk, and give it its name."""
        with self._writing():
            self._writer.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            os.replace(self._part, self._path)
            folder = os.open(self._path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def discard(self) -> None:
        """Throw the unfinished file away."""
        try:
            self._stream.close()
        except OSError as error:
            if error.errno not in UNWRITABLE:  # a full disk cannot take the rest of what is thrown away
                raise
        self._part.unlink(missing_ok=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(
                f"cannot write {self._part}: {error.strerror}; "
                "episodes finished before are whole; make room, then record on into another --out"
            ) from error


@dataclass(frozen=True)
class Topic:
    """What a file says of the messages on a topic."""

    encoding: str
    """Of the messages: cdr, json, protobuf."""
    schema: str
    """Name of the message type, for example sensor_msgs/msg/JointState; empty where there is none."""
    schema_encoding: str
    """Of the definition: ros2msg, jsonschema, protobuf."""
    definition: bytes
    """The message type's definition."""
    about: Mapping[str, str]
    """The channel's metadata; in our recordings unit and frame."""


@dataclass(frozen=True)
class McapContent:
    """Everything in a file, as bytes."""

    messages: Mapping[str, list[tuple[int, bytes]]]
    """Topic to (log time [ns], data), in the order of time."""
    topics: Mapping[str, Topic]
    """Topic to what the file says of it; also of topics without a message."""
    metadata: Mapping[str, Mapping[str, str]]
    attachments: Mapping[str, bytes]


def read_mcap(path: Path) -> McapContent:
    """Read a whole file, every checksum compared.

    Raises `RecordingError` for a file that is not there, truncated, damaged, or no MCAP at all.
    """
    if not path.is_file():
        raise RecordingError(f"no recording {path}")
    messages: dict[str, list[tuple[int, bytes]]] = {}
    topics: dict[str, Topic] = {}
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            for schema, channel, message in reader.iter_messages():
                if channel.topic not in topics:
                    told = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
                    topics[channel.topic] = Topic(channel.message_encoding, *told, channel.metadata)
                messages.setdefault(channel.topic, []).append((message.log_time, message.data))
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            attachments = {record.name: record.data for record in reader.iter_attachments()}
    except DAMAGE as error:
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise RecordingError(
            f"{path} is truncated, damaged or no MCAP file ({reason}); record the episode again or leave the file out"
        ) from error
    return McapContent(messages, topics, metadata, attachments)
