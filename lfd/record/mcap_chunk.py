"""A chunk of an MCAP file: message records, compressed, with their index.

Chunks are written again and again while an episode runs, so their records are put together here by hand and not by the
library, which writes number by number.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt16
from zstandard import ZstdCompressor

CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 0x06, 0x07, 0x08
COMPRESSION = struct.pack("<I", 4) + b"zstd"
CHUNK_HEAD = struct.Struct("<BQQQQI")
"""Opcode, length, first and last log time, uncompressed size and checksum."""
INDEX_HEAD = struct.Struct("<BQHI")
"""Opcode, length, channel, bytes of entries."""
INDEX_ENTRY = np.dtype([("channel", "<u2"), ("place", "<u8")])


@dataclass(frozen=True)
class Records:
    """Message records that follow one another, in the order of time."""

    data: bytes
    channels: UInt16[np.ndarray, "M"]
    offsets: Int[np.ndarray, "M"]
    """Place of each in `data`."""
    times_ns: Int[np.ndarray, "M"]


@dataclass(frozen=True)
class PackedChunk:
    """What a chunk adds to a file."""

    data: bytes
    """The chunk's record and the records of its index."""
    index: bytes
    """The record in the file's summary that tells of it."""
    counts: dict[int, int]
    """Channel to its messages."""
    first: int
    """First log time [ns]."""
    last: int
    """Last log time [ns]."""


class OpenChunk:
    """Messages that wait to be written."""

    def __init__(self) -> None:
        self._compressor = ZstdCompressor(level=1)
        self.clear()

    def clear(self) -> None:
        self.records: list[Records] = []
        self.size = self.first = self.last = 0

    def add(self, records: Records) -> None:
        first, last = int(records.times_ns[0]), int(records.times_ns[-1])
        self.first = min(self.first, first) if self.records else first
        self.last = max(self.last, last) if self.records else last
        self.records.append(records)
        self.size += len(records.data)

    def pack(self, at: int) -> PackedChunk:
        """The chunk as it stands from place `at` of the file on."""
        data = b"".join(part.data for part in self.records)
        packed = self._compressor.compress(data)
        body = COMPRESSION + struct.pack("<Q", len(packed)) + packed
        length = CHUNK_HEAD.size - 9 + len(body)
        chunk = CHUNK_HEAD.pack(CHUNK, length, self.first, self.last, len(data), zlib.crc32(data)) + body
        channels, counts, entries = self._entries()
        parts, places, begin, place = [], [], 0, at + len(chunk)
        for channel, count in zip(channels, counts, strict=True):
            content = entries[16 * begin : 16 * (begin + count)]
            parts += [INDEX_HEAD.pack(MESSAGE_INDEX, 6 + len(content), channel, len(content)), content]
            places.append((channel, place))
            begin, place = begin + count, place + INDEX_HEAD.size + len(content)
        offsets = np.array(places, dtype=INDEX_ENTRY).tobytes()
        told = struct.pack("<QQQQI", self.first, self.last, at, len(chunk), len(offsets)) + offsets
        told += struct.pack("<Q", place - at - len(chunk)) + COMPRESSION + struct.pack("<QQ", len(packed), len(data))
        return PackedChunk(
            data=chunk + b"".join(parts),
            index=struct.pack("<BQ", CHUNK_INDEX, len(told)) + told,
            counts=dict(zip(channels, counts, strict=True)),
            first=self.first,
            last=self.last,
        )

    def _entries(self) -> tuple[list[int], list[int], bytes]:
        """Channels, messages of each, and log time and place in the chunk of all messages, channel after channel."""
        begins = np.cumsum([0, *(len(part.data) for part in self.records)])
        channels = np.concatenate([part.channels for part in self.records])
        places = np.concatenate([begin + part.offsets for begin, part in zip(begins, self.records, strict=False)])
        times = np.concatenate([part.times_ns for part in self.records])
        order = np.argsort(channels, kind="stable")
        counts = np.bincount(channels)
        there = np.flatnonzero(counts)
        entries = np.array([times, places], dtype="<u8").T[order]
        return there.tolist(), counts[there].tolist(), entries.tobytes()
