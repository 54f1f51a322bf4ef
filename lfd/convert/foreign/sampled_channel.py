"""One channel on its way from samples to rows: its method, its values at the rows, its gaps."""

from dataclasses import dataclass
from itertools import combinations
from math import pi

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from lfd.convert.foreign import resample
from lfd.convert.foreign.field_path import meet
from lfd.convert.foreign.mapping import MapEntry
from lfd.convert.foreign.samples import Samples, is_quaternion, unit_quaternions
from lfd.convert.foreign.units import UNITS
from lfd.core.errors import RecordingError


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One entry of the recipe with what it measured."""

    name: str
    entry: MapEntry
    samples: Samples
    method: str
    max_gap_s: float


@dataclass(frozen=True, kw_only=True)
class Rows:
    """A channel at the T times of the rows."""

    valid: Bool[np.ndarray, "T"]
    values: Shaped[np.ndarray, "T D"] | None
    """Numbers; what stands in an invalid row means nothing."""
    index: Int[np.ndarray, "T"] | None
    """Which sample stands in each row, where one does: the picture."""


@dataclass(frozen=True, kw_only=True)
class Gap:
    """A time without a sample that is too long for some row."""

    channel: Channel
    sample: int
    """The last one before it."""
    at_s: float
    """When it begins, after the first row [s]."""
    seconds: float


def channel_of(name: str, entry: MapEntry, samples: Samples, max_gap_s: float) -> Channel:
    """The channel with its method; the recipe's key `method` says the rule.

    Raises `RecordingError` for a method that the numbers do not allow.
    """
    values = samples.values
    method = entry.method or _usual_method(entry, samples)
    if values is not None and values.dtype == bool and method in ("linear", "slerp"):
        raise RecordingError(f'{samples.where} holds flags; set method = "hold" in [map.{name}]')
    channel = Channel(name=name, entry=entry, samples=samples, method=method, max_gap_s=max_gap_s)
    if method == "linear" and UNITS[entry.unit].si == "rad":
        _refuse_wrapping(channel)
    return channel


def _usual_method(entry: MapEntry, samples: Samples) -> str:
    if entry.latched:
        return "hold"
    if samples.values is None:
        return "nearest"
    if entry.feature == "action" or samples.values.dtype == bool:
        return "hold"
    return "slerp" if is_quaternion(samples) else "linear"


def _refuse_wrapping(channel: Channel) -> None:
    """An angle that goes from pi to -pi has no line between: half way it would point backwards."""
    samples = channel.samples
    assert samples.values is not None
    close = np.diff(samples.times_ns) <= channel.max_gap_s * 1e9
    jumps = np.abs(np.diff(samples.values, axis=0)) * close[:, None]
    if jumps.size and jumps.max() > pi:
        at, component = np.unravel_index(jumps.argmax(), jumps.shape)
        raise RecordingError(
            f"{samples.where}: {samples.names[component]} jumps by {jumps[at, component]:.4g} rad before sample "
            f"{at + 1}, {samples.moment(int(at) + 1)}: the angle wraps round, and a line between would be wrong; "
            f'set method = "nearest" in [map.{channel.name}]'
        )


def refuse_doubles(channels: list[Channel]) -> None:
    """Two channels may not have a number of the source in common.

    Which they have shows only now where components are names that the recipe gives. Raises `RecordingError`.
    """
    for a, b in combinations(channels, 2):
        if a.entry.topic != b.entry.topic or not meet(a.entry.path(a.name), b.entry.path(b.name)):
            continue
        named = not (a.samples.renamed or b.samples.renamed)
        if named and set(a.samples.names).isdisjoint(b.samples.names):
            continue
        raise RecordingError(
            f"{a.samples.where}: [map.{a.name}] and [map.{b.name}] both map {a.entry.field or 'the message'}; "
            "map a channel once, or give parts that differ, such as data[0:3] and data[3:6]"
        )


def rows_of(channel: Channel, start_ns: int, rows: Float[np.ndarray, "T"]) -> Rows:
    """The channel at the times `rows` [s] after `start_ns`."""
    times, values, gap = channel.samples.seconds_after(start_ns), channel.samples.values, channel.max_gap_s
    if channel.method in ("hold", "nearest"):
        index, valid = (resample.hold if channel.method == "hold" else resample.nearest)(times, rows, gap)
        return Rows(valid=valid, values=None if values is None else values[index], index=index)
    assert values is not None
    if channel.method == "linear":
        between, valid = resample.linear(times, values, rows, gap)
        return Rows(valid=valid, values=between, index=None)
    quats = unit_quaternions(channel.samples, channel.name)
    between, valid = resample.slerp(times, quats, rows, gap)
    return Rows(valid=valid, values=between, index=None)


def gaps_of(channel: Channel, found: Rows, start_ns: int, rows: Float[np.ndarray, "T"]) -> list[Gap]:
    """The times without a sample in which the channel has an invalid row."""
    times = channel.samples.seconds_after(start_ns)
    before = np.unique(np.searchsorted(times, rows[~found.valid], side="right") - 1)
    return [
        Gap(channel=channel, sample=i, at_s=float(times[i]), seconds=float(times[i + 1] - times[i]))
        for i in map(int, before)
    ]
