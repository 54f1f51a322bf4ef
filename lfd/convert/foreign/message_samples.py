"""A topic of an MCAP file as samples: decode its messages, find the field, name its numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int64

from lfd.convert.foreign.field_path import Step, members_of
from lfd.convert.foreign.mapping import MapEntry
from lfd.convert.foreign.message_decoding import UNDECODABLE, Decoder, decode_message, decoder_of, log_time
from lfd.convert.foreign.message_fields import frame_of, numbers_at, stamp_of
from lfd.convert.foreign.message_pictures import MessagePictures, holds_picture
from lfd.convert.foreign.samples import Samples
from lfd.convert.foreign.units import defined_dimensions
from lfd.convert.frames import Pictures
from lfd.core.errors import RecordingError
from lfd.record.mcap_file import Topic

Messages = Sequence[tuple[int, bytes]]
"""Log time [ns] and data."""
LATEST_NS = 2**62
"""In the year 2116; twice as much no longer fits 64 bits."""


def samples_of_topic(topic: Topic, messages: Messages, where: str, entry: MapEntry, clock: str) -> Samples:
    """What the messages of a topic say in the field of `entry`, on the clock `header` or `log`.

    `where` is file and topic. Raises `RecordingError` for no messages, messages that cannot be decoded, a field that
    is not there or holds no numbers, and numbers whose count or names change on the way.
    """
    if not messages:
        raise RecordingError(f"{where} has no messages; leave the recording out (--skip-bad)")
    decoder = decoder_of(topic, where)
    told = f"{where}, field {entry.field}" if entry.field else where
    found = _Found(told, entry, decoder, entry.path(where))
    first = decode_message(decoder, messages[0][1], where, messages[0][0])
    pictured = holds_picture(decoder.members(first))
    stamps = [0] * len(messages)
    frames: dict[str, int] = {}
    for at, (time_ns, data) in enumerate(messages):
        message = decode_message(decoder, data, where, time_ns)
        if pictured or found.take(message, at, time_ns):
            stamps[at] = stamp_of(message, decoder)
            frames.setdefault(frame_of(message, decoder), at if pictured else len(found.rows) - 1)
    used = "header" if clock == "header" and any(stamps) else "log"
    times_ns = _times(messages, stamps if used == "header" else [0] * len(messages), where)
    if pictured:
        shape = MessagePictures(topic, where)(messages[0][1]).shape
        pictures = Pictures([data for _, data in messages], MessagePictures(topic, where, shape))
        return Samples(where=where, times_ns=times_ns, pictures=pictures, frames=frames, clock=used)
    return Samples(
        where=told,
        times_ns=times_ns[found.kept()],
        values=np.array(found.rows),
        names=found.names,
        unit=topic.about.get("unit", ""),
        dimensions=defined_dimensions(topic.schema, members_of(found.path)),
        frames=frames,
        clock=used,
    )


def _times(messages: Messages, stamps: list[int], where: str) -> Int64[np.ndarray, "M"]:
    """The stamps, and the log times where they are 0."""
    times_ns = [stamp or time_ns for (time_ns, _), stamp in zip(messages, stamps, strict=True)]
    for at, time_ns in enumerate(times_ns):
        if abs(time_ns) >= LATEST_NS:
            raise RecordingError(
                f"{where}: message {at} at log time {log_time(messages[at][0])} has the time {time_ns} ns, "
                "which is no date; leave the recording out (--skip-bad)"
            )
    return np.array(times_ns, dtype=np.int64)


@dataclass
class _Found:
    """The numbers of a field, message after message."""

    told: str
    entry: MapEntry
    decoder: Decoder
    path: tuple[Step, ...]
    names: tuple[str, ...] = ()
    rows: list[np.ndarray] = field(default_factory=list)
    times_ns: list[int] = field(default_factory=list)
    taken: list[bool] = field(default_factory=list)
    others: tuple[str, ...] = ()

    def take(self, message: object, at: int, time_ns: int) -> bool:
        """Take a message's numbers; False when it has none of the recipe's components.

        Such a message counts as another publisher's: a gripper's joints may come on the arm's topic.
        """
        try:
            numbers, names = numbers_at(message, self.decoder, self.path)
        except UNDECODABLE as error:
            raise RecordingError(
                f"{self.told}, message {at} at log time {log_time(time_ns)}: {error}; "
                "correct the recipe, or leave the recording out (--skip-bad)"
            ) from error
        if not len(numbers):
            raise RecordingError(
                f"{self.told} is empty in message {at} at log time {log_time(time_ns)}: "
                "who wrote it does not measure it; map another field"
            )
        wanted = self.entry.components
        counts = not (names and wanted and set(names).isdisjoint(wanted))
        self.taken.append(counts)
        if not counts:
            self.others = names
            return False
        if wanted and set(wanted) <= set(names):
            numbers, names = numbers[[names.index(name) for name in wanted]], wanted
        if self.rows and (len(numbers) != len(self.rows[0]) or names != self.names):
            raise RecordingError(
                f"{self.told} changes on the way: {_called(self.rows[0], self.names)} at log time "
                f"{log_time(self.times_ns[0])}, {_called(numbers, names)} in message {at} at {log_time(time_ns)}; "
                "pick components by name, or leave the recording out (--skip-bad)"
            )
        self.names = names
        self.rows.append(numbers)
        self.times_ns.append(time_ns)
        return True

    def kept(self) -> Bool[np.ndarray, "M"]:
        """Which messages count.

        Raises `RecordingError` when none does.
        """
        if not self.rows:
            raise RecordingError(
                f"{self.told} has none of the components {', '.join(self.entry.components)}; "
                f"it has {', '.join(self.others)}"
            )
        return np.array(self.taken)


def _called(numbers: np.ndarray, names: tuple[str, ...]) -> str:
    return f"{len(numbers)} numbers" + (f" ({', '.join(names)})" if names else "")
