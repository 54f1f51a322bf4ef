"""Writes MCAP files that are whole or named `.part`, and takes the messages of many steps at once.

A file is written under a `.part` name and renamed when it is closed: a finished name always means a whole file.
Messages are collected into chunks, each compressed, with a checksum and an index; a chunk goes to the operating
system before the messages in it span more than `FLUSH_NS`, which a killed process loses of what was handed over here.
(The recorder loses less: `lfd.record.journal`.) `lfd recover` turns the chunks of a `.part` file into an episode.

The library's own writer takes messages one by one; here the messages of steps can be handed over as one block of bytes
(`lfd.record.layouts`).
"""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC, Writer

from lfd.core.artifact import UNWRITABLE
from lfd.core.errors import OutputError
from lfd.record.cdr import schema_text
from lfd.record.mcap_chunk import OpenChunk, PackedChunk, Records

CHUNK_BYTES = 256 * 1024
FLUSH_NS = 400_000_000
"""Longest time between the first and the last message that wait in memory [ns], but for the last step."""
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence number (not used), log time, publish time."""


def library_writer(stream: Any) -> Writer:
    """The library's own writer, to compare with."""
    return Writer(stream, chunk_size=CHUNK_BYTES)


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
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._chunk, self._chunks = OpenChunk(), list[PackedChunk]()
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._crc = self._at = 0
        with self._writing():
            self._put(MCAP0_MAGIC)
            self._record(Header("ros2", "lfd"))

    def channel(self, topic: str, message_type: str, about: Mapping[str, str]) -> None:
        """Announce a topic, unless it is known already; `about` says unit and frame."""
        if topic in self._channels:
            return
        with self._writing():
            if message_type not in self._schemas:
                definition = schema_text(message_type).encode()
                schema = Schema(len(self._schemas) + 1, definition, "ros2msg", message_type)
                self._schemas[message_type] = schema
                self._record(schema)  # outside the chunks: what is there belongs to every chunk that can be saved
            number, schema = len(self._channels) + 1, self._schemas[message_type].id
            self._channels[topic] = Channel(number, topic, "cdr", dict(about), schema)
            self._record(self._channels[topic])

    def number(self, topic: str) -> int:
        """The number that stands for a topic in message records."""
        return self._channels[topic].id

    def message(self, topic: str, time_ns: int, data: bytes) -> None:
        """Append a message."""
        number = self._channels[topic].id
        head = MESSAGE_HEAD.pack(Opcode.MESSAGE, 22 + len(data), number, 0, time_ns, time_ns)
        one = np.array([number], dtype=np.uint16), np.array([0]), np.array([time_ns])
        self.records(Records(head + data, *one))

    def records(self, records: Records) -> None:
        """Append several messages at once."""
        chunk = self._chunk
        if chunk.records and (
            records.times_ns[-1] - chunk.first > FLUSH_NS or chunk.size + len(records.data) > CHUNK_BYTES
        ):
            self.flush()
        chunk.add(records)

    def flush(self) -> None:
        """Hand everything to the operating system."""
        with self._writing():
            self._write_chunk()
            self._stream.flush()

    def metadata(self, name: str, content: Mapping[str, str]) -> None:
        with self._writing():
            self._write_chunk()
            place = self._record(Metadata(name, dict(content)))
            self._metadata.append(MetadataIndex(*place, name))

    def attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        with self._writing():
            self._write_chunk()
            place = self._record(Attachment(time_ns, time_ns, name, media_type, data))
            self._attachments.append(AttachmentIndex(*place, time_ns, time_ns, len(data), name, media_type))

    def finish(self) -> None:
        """Close the file, make sure that it is on the disk, and give it its name."""
        with self._writing():
            self._write_chunk()
            self._record(DataEnd(self._crc))
            self._write_summary()
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

    def _put(self, data: bytes) -> None:
        self._stream.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._at += len(data)

    def _record(self, record: Any) -> tuple[int, int]:
        """Write one record; its place and length."""
        builder, at = RecordBuilder(), self._at
        record.write(builder)
        data = builder.end()
        self._put(data)
        return at, len(data)

    def _write_chunk(self) -> None:
        if not self._chunk.records:
            return
        packed = self._chunk.pack(self._at)
        self._put(packed.data)
        self._chunks.append(packed)
        self._chunk.clear()

    def _write_summary(self) -> None:
        start, builder = self._at, RecordBuilder()
        counts = Counter[int]()
        for chunk in self._chunks:
            counts.update(chunk.counts)
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=counts.total(),
            metadata_count=len(self._metadata),
            message_start_time=min((chunk.first for chunk in self._chunks), default=0),
            message_end_time=max((chunk.last for chunk in self._chunks), default=0),
            schema_count=len(self._schemas),
        )
        groups: Mapping[Opcode, Sequence[Any]] = {
            Opcode.SCHEMA: list(self._schemas.values()),
            Opcode.CHANNEL: list(self._channels.values()),
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: [_Written(chunk.index) for chunk in self._chunks],
            Opcode.ATTACHMENT_INDEX: self._attachments,
            Opcode.METADATA_INDEX: self._metadata,
        }
        places = []
        for opcode, records in groups.items():
            begin = builder.count
            for record in records:
                record.write(builder)
            places.append(SummaryOffset(opcode, start + begin, builder.count - begin))
        offsets_at = start + builder.count
        for place in places:
            place.write(builder)
        summary = builder.end()
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_at)
        self._put(summary)
        self._record(Footer(start, offsets_at, zlib.crc32(head, zlib.crc32(summary))))
        self._put(MCAP0_MAGIC)

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
class _Written:
    """A record that is put together already."""

    data: bytes

    def write(self, builder: RecordBuilder) -> None:
        builder.write(self.data)
