"""Reads MCAP files of any program: everything in them as bytes, or as much as a crash or damage left.

Every checksum is compared. Sizes that a file claims are compared with what is there before memory is taken for them, so
that damage costs an error and not the machine. Records are found by hand, which is several times faster than the
library's reader; rare ones are taken apart by the library.
"""

import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC as MAGIC

from lfd.core.errors import RecordingError

SUFFIX = ".mcap"
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, KeyError, OverflowError, EOFError, AssertionError,
          IndexError, RuntimeError, MemoryError)  # fmt: skip
"""What reading a damaged file can raise; UnicodeDecodeError is a ValueError, lz4 raises RuntimeError."""
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence number, log time, publish time."""
CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last log time, uncompressed size, checksum, length of the compression's name."""
MOST_UNPACKED = 64, 64 * 2**20
"""A chunk may unpack to so many times its size, or to so many bytes, whichever is more."""


UNKNOWN_SIZE = -1
"""What zstandard answers for a frame that does not say its size."""


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


@dataclass
class McapContent:
    """Everything in a file, as bytes."""

    messages: dict[str, list[tuple[int, bytes]]] = field(default_factory=dict)
    """Topic to (log time [ns], data), in the order of time."""
    topics: dict[str, Topic] = field(default_factory=dict)
    """Topic to what the file says of it; also of topics without a message."""
    jumps: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Topic whose clock ran back in the file to the log times [ns] before and after the first jump."""
    metadata: dict[str, Mapping[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)


def read_mcap(path: Path) -> McapContent:
    """Read a whole file, every checksum compared.

    Raises `RecordingError` for a file that is not there, truncated, damaged, or no MCAP at all.
    """
    whole = _bytes_of(path)
    data, reading = memoryview(whole), _Reading()
    try:
        if data[: len(MAGIC)] != MAGIC:
            raise ValueError("it does not begin like one")
        at = len(MAGIC)
        for opcode, begin, end in _records(data, at):
            reading.take(opcode, data[begin:end], before=data[: begin - 9])
            if opcode == Opcode.FOOTER:
                at = end
                break
        else:
            raise EOFError("it was never finished")
        if data[at:] != MAGIC:
            raise ValueError("it does not end like one")
        return reading.content()
    except DAMAGE as error:
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise RecordingError(
            f"{path} is truncated, damaged or no MCAP file ({reason}); record the episode again, leave the file out, "
            f"or save what is whole with `lfd recover {path.parent}`"
        ) from error


def metadata_of(path: Path) -> Mapping[str, Mapping[str, str]]:
    """The metadata that stand before the messages of a file, without reading those.

    Raises `RecordingError` for a file that is damaged before them.
    """
    data, reading = memoryview(_bytes_of(path)), _Reading()
    try:
        for opcode, begin, end in _records(data, len(MAGIC)):
            if opcode in (Opcode.CHUNK, Opcode.DATA_END):
                break
            reading.take(opcode, data[begin:end])
    except DAMAGE as error:
        raise RecordingError(f"{path} is truncated, damaged or no MCAP file ({error})") from error
    return reading.content(check=False).metadata


def salvage_mcap(path: Path) -> tuple[McapContent, int]:
    """What is whole of a damaged or unfinished file, and the bytes that are not.

    Reads on behind damage from the next chunk whose checksum is right. Raises `RecordingError` when there is nothing.
    """
    whole = _bytes_of(path)
    data, reading, at, lost = memoryview(whole), _Reading(), 0, 0
    if data[: len(MAGIC)] == MAGIC:
        at = len(MAGIC)
    while at < len(data):
        try:
            for opcode, begin, end in _records(data, at):
                if opcode == Opcode.FOOTER:
                    return reading.content(check=False), lost
                reading.take(opcode, data[begin:end])
                at = end
            raise EOFError
        except DAMAGE:
            further = _next_chunk(whole, at + 1)
            lost += further - at
            at = further
    if not reading.channels:
        raise RecordingError(f"{path} holds nothing that can be saved: not one whole chunk")
    return reading.content(check=False), lost


def _bytes_of(path: Path) -> bytes:
    if not path.is_file():
        raise RecordingError(f"no recording {path}")
    return path.read_bytes()


def _records(data: memoryview, at: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and end of each record's content; raises what is in `DAMAGE` where one is cut off."""
    while at < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        at += RECORD_HEAD.size
        if length > len(data) - at:
            raise EOFError(f"a record of {length} bytes is cut off")
        yield opcode, at, at + length
        at += length


def _next_chunk(data: bytes, at: int) -> int:
    """Place of the next record that may be a chunk, or the end."""
    while True:
        marks = [data.find(struct.pack("<I", len(name)) + name, at) for name in (b"zstd", b"lz4")]
        found = min((mark for mark in marks if mark >= 0), default=-1)
        if found < 0:
            return len(data)
        begin = found - RECORD_HEAD.size - CHUNK_HEAD.size + 4
        if begin >= at and data[begin] == Opcode.CHUNK:
            return begin
        at = found + 1


class _Reading:
    """What was read so far."""

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._messages: dict[int, list[tuple[int, bytes]]] = {}
        self._metadata: dict[str, Mapping[str, str]] = {}
        self._attachments: dict[str, bytes] = {}
        self._expected: int | None = None

    def take(self, opcode: int, content: memoryview, before: memoryview | None = None) -> None:
        """Take a record in; `before` is all of the file that stands before it.

        Raises what is in `DAMAGE`.
        """
        if opcode == Opcode.CHUNK:
            self._take_chunk(_unpack_chunk(content))
        elif opcode == Opcode.MESSAGE:
            self._take_chunk(RECORD_HEAD.pack(Opcode.MESSAGE, len(content)) + bytes(content))
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(content))
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(content))
            self.channels[channel.id] = channel
            self._messages.setdefault(channel.id, [])
        elif opcode == Opcode.METADATA:
            record = Metadata.read(_stream(content))
            self._metadata[record.name] = record.metadata
        elif opcode == Opcode.ATTACHMENT:
            check = int.from_bytes(content[-4:], "little")
            if check and zlib.crc32(content[:-4]) != check:
                raise ValueError("the checksum of an attachment is wrong")
            record = Attachment.read(_stream(content))
            self._attachments[record.name] = record.data
        elif opcode == Opcode.DATA_END and before is not None:
            check = DataEnd.read(_stream(content)).data_section_crc
            if check and zlib.crc32(before) != check:
                raise ValueError("the checksum of the file is wrong")
        elif opcode == Opcode.FOOTER and before is not None:
            self._check_summary(content, before)
        elif opcode == Opcode.STATISTICS:
            self._expected = Statistics.read(_stream(content)).message_count

    def _check_summary(self, content: memoryview, before: memoryview) -> None:
        """Compare the checksum that the footer has of the summary and of itself."""
        footer = Footer.read(_stream(content))
        head = RECORD_HEAD.pack(Opcode.FOOTER, len(content)) + bytes(content[:16])
        if footer.summary_crc and zlib.crc32(head, zlib.crc32(before[footer.summary_start :])) != footer.summary_crc:
            raise ValueError("the checksum of the summary is wrong")

    def _take_chunk(self, data: bytes) -> None:
        """Take the records of a chunk in; the loop that reading a file spends its time in."""
        at, end, unpack, known = 0, len(data), MESSAGE.unpack_from, self._messages
        while at < end:
            if data[at] != Opcode.MESSAGE:
                opcode, begin, then = next(_records(memoryview(data), at))
                self.take(opcode, memoryview(data)[begin:then])
                at = then
                continue
            _, length, number, _, log_time, _ = unpack(data, at)
            then = at + RECORD_HEAD.size + length
            if then > end or length < MESSAGE.size - RECORD_HEAD.size:
                raise EOFError(f"a message of {length} bytes is cut off")
            if number not in known:
                raise ValueError(f"a message of channel {number}, which the file does not describe")
            known[number].append((log_time, data[at + MESSAGE.size : then]))
            at = then

    def content(self, *, check: bool = True) -> McapContent:
        """Everything by topic."""
        found = sum(map(len, self._messages.values()))
        if check and self._expected not in (None, found):
            raise ValueError(f"it has {found} messages, and says that it has {self._expected}")
        content = McapContent(metadata=self._metadata, attachments=self._attachments)
        for number, channel in self.channels.items():
            schema = self._schemas.get(channel.schema_id)
            told = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
            topic = Topic(channel.message_encoding, *told, channel.metadata)
            first = content.topics.setdefault(channel.topic, topic)
            if (first.schema, first.encoding) != (topic.schema, topic.encoding):
                if not check:  # the record that describes the channel is damaged
                    continue
                raise ValueError(f"topic {channel.topic} has messages of two types, {first.schema} and {topic.schema}")
            if self._messages[number]:
                content.messages.setdefault(channel.topic, []).extend(self._messages[number])
                _note_jump(content, channel.topic, [time_ns for time_ns, _ in self._messages[number]])
        for messages in content.messages.values():
            times = [time_ns for time_ns, _ in messages]
            if times != sorted(times):
                messages.sort(key=lambda message: message[0])
        return content


def _note_jump(content: McapContent, topic: str, times_ns: list[int]) -> None:
    """Note where the log times of a channel run back."""
    if times_ns != sorted(times_ns):
        jump = next((before, after) for before, after in pairwise(times_ns) if after < before)
        content.jumps.setdefault(topic, jump)


def _stream(content: memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _unpack_chunk(content: memoryview) -> bytes:
    """The records in a chunk, decompressed, the checksum compared."""
    _, _, size, check, name_length = CHUNK_HEAD.unpack_from(content)
    at = CHUNK_HEAD.size + name_length
    compression = bytes(content[CHUNK_HEAD.size : at]).decode()
    (length,) = struct.unpack_from("<Q", content, at)
    packed = content[at + 8 :]
    if length != len(packed):
        raise ValueError(f"a chunk of {length} bytes has {len(packed)}")
    times, bytes_ = MOST_UNPACKED
    if size > max(times * length, bytes_):
        raise ValueError(f"a chunk of {length} bytes claims to unpack to {size}")
    data: Any
    if compression == "zstd":
        if zstandard.frame_content_size(packed) not in (size, UNKNOWN_SIZE):
            raise ValueError("a chunk's sizes contradict each other")
        data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    elif compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
    elif compression == "":
        data = bytes(packed)
    else:
        raise ValueError(f"a chunk is compressed by {compression!r}, which lfd does not know")
    if len(data) != size:
        raise ValueError(f"a chunk unpacks to {len(data)} bytes instead of {size}")
    if check and zlib.crc32(data) != check:
        raise ValueError("the checksum of a chunk is wrong")
    return data
