"""Where the numbers stand in a message whose other bytes are always the same.

The messages of a topic differ in their stamps and their float64 numbers alone, as long as names and sizes stay. So
one message is packed the plain way (`lfd.record.cdr`), and what it tells serves all others: a step is written by
copying its numbers into a block of bytes, and a whole topic is read by one indexing operation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int, UInt8

from lfd.record.mcap_chunk import Records
from lfd.record.mcap_writing import MESSAGE_HEAD

Pack = Callable[[int, Float[np.ndarray, "F"]], bytes]
"""Packs a message from its stamp [ns] and its numbers."""
PROBE_STAMP = 0x01010101 * 10**9 + 0x01010101
"""A stamp of which no byte is zero, neither of its seconds nor of its nanoseconds."""
PROBE = np.frombuffer(b"\xff" * 8)[0]
"""A number (not finite) of which no byte is zero."""


@dataclass(frozen=True)
class Layout:
    """The bytes of a message, and which of them are its numbers and stamps."""

    template: UInt8[np.ndarray, "bytes"]
    """The message with zeros for numbers and stamps."""
    numbers: Int[np.ndarray, "8F"]
    """Places of the numbers' bytes, in the order in which they are packed."""
    stamps: Int[np.ndarray, "S 8"]
    """Places of the stamps' bytes: seconds (4), then nanoseconds (4)."""

    @classmethod
    def of(cls, pack: Pack, size: int) -> "Layout":
        """The layout of messages that `pack` makes of `size` numbers."""

        def packed(stamp: int, number: float) -> np.ndarray:
            return np.frombuffer(pack(stamp, np.full(size, number)), np.uint8)

        zero = packed(0, 0.0)
        numbers = np.flatnonzero(packed(0, PROBE) != zero)
        assert len(numbers) == 8 * size, "packing must keep the numbers as they are and in their order"
        return cls(zero, numbers, np.flatnonzero(packed(PROBE_STAMP, 0.0) != zero).reshape(-1, 8))

    def read(self, messages: Sequence[bytes]) -> Float[np.ndarray, "N F"] | None:
        """The numbers of messages, or None when one of them has other names or sizes."""
        size = len(self.template)
        if set(map(len, messages)) != {size}:
            return None
        rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), size)
        if any((rows[:, begin:end] != self.template[begin:end]).any() for begin, end in self._fixed):
            return None
        parts = [rows[:, place : place + end - begin] for place, begin, end in runs_of(self.numbers[::8])]
        return np.concatenate(parts, axis=1).view("<f8")

    @cached_property
    def _fixed(self) -> list[tuple[int, int]]:
        """Begin and end of every run of bytes that are neither numbers nor stamps."""
        is_fixed = np.ones(len(self.template) + 2, dtype=bool)
        is_fixed[1:-1][self.numbers] = is_fixed[1:-1][self.stamps] = False
        is_fixed[[0, -1]] = False
        edges = np.flatnonzero(np.diff(is_fixed))
        return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


@dataclass(frozen=True)
class BlockMessage:
    """One message of a block."""

    channel: int
    """Number of its topic in the file."""
    layout: Layout
    late: bool
    """Whether it stands at the second of the block's two times."""


class StepBlock:
    """The message records of a control step, always the same but for numbers and stamps; filled for some steps at once.

    A step has two times: that of its action and that of the observation after it.
    """

    def __init__(self, messages: Sequence[BlockMessage]):
        parts, numbers, at = [], [], 0
        stamps: tuple[list[np.ndarray], list[np.ndarray]] = [], []
        clocks: tuple[list[np.ndarray], list[np.ndarray]] = [], []
        offsets = []
        for message in messages:
            body = message.layout
            head = np.frombuffer(MESSAGE_HEAD.pack(5, 22 + len(body.template), message.channel, 0, 0, 0), np.uint8)
            offsets.append(at)
            clocks[message.late].append(at + 15 + np.arange(16).reshape(2, 8))  # log time, publish time
            numbers.append(at + len(head) + body.numbers)
            stamps[message.late].append(at + len(head) + body.stamps)
            parts += [head, body.template]
            at += len(head) + len(body.template)
        self._channels = np.array([m.channel for m in messages], dtype=np.uint16)
        self._late = np.array([m.late for m in messages], dtype=int)
        self._offsets = np.array(offsets)
        self._bytes = np.concatenate(parts)
        self._runs = runs_of(np.concatenate(numbers)[::8])
        none = np.empty((0, 8), dtype=int)
        self._stamps = [np.concatenate([none, *places]) for places in stamps]
        self._clocks = [np.concatenate([none, *places]) for places in clocks]

    def fill(self, numbers: Float[np.ndarray, "N F"], times_ns: Int[np.ndarray, "N 2"]) -> "Records":
        """The records of N steps: the numbers of all messages, one after the other, and the two times of each step."""
        steps = len(numbers)
        block = np.tile(self._bytes, (steps, 1))
        content = np.ascontiguousarray(numbers).view(np.uint8)
        for place, begin, end in self._runs:
            block[:, place : place + end - begin] = content[:, begin:end]
        for times, stamps, clocks in zip(times_ns.T, self._stamps, self._clocks, strict=True):
            split = np.stack(np.divmod(times, 10**9), axis=1).astype("<u4").view(np.uint8)
            block[:, stamps] = split[:, None]
            block[:, clocks] = np.ascontiguousarray(times).astype("<u8").view(np.uint8).reshape(steps, 1, 8)
        offsets = len(self._bytes) * np.arange(steps)[:, None] + self._offsets
        channels = np.tile(self._channels, steps)
        return Records(block.tobytes(), channels, offsets.reshape(-1), times_ns[:, self._late].reshape(-1))


def runs_of(places: Int[np.ndarray, "F"]) -> list[tuple[int, int, int]]:
    """Runs of numbers that stand side by side: place of the first, and which bytes of all numbers they are."""
    edges = [0, *(np.flatnonzero(np.diff(places) != 8) + 1).tolist(), len(places)]
    return [(int(places[begin]), 8 * begin, 8 * end) for begin, end in pairwise(edges) if begin < end]
