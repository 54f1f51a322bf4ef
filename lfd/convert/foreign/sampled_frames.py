"""Samples of many clocks to the rows of episodes, at the rate of the recipe.

The rows begin where every channel has a sample and end where the first channel ends. A row that some channel cannot
fill within its longest gap refuses the recording, or splits it there: nothing is filled in.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from lfd.convert.foreign import resample
from lfd.convert.foreign.mapping import MapEntry, MapRecipe, ResampleRecipe
from lfd.convert.foreign.sampled_channel import Channel, Gap, Rows, channel_of, gaps_of, refuse_doubles, rows_of
from lfd.convert.foreign.samples import Samples, checked
from lfd.convert.foreign.units import UNITS
from lfd.convert.frames import EpisodeFrames, Pictures
from lfd.core.errors import RecordingError

SamplesOf = Callable[[MapEntry], Samples]
"""What a source has for an entry `[map.NAME]` of the recipe."""
MOST_ROWS = 10_000_000
"""More than four days at 30 Hz are a mistake in the stamps, and would fill the memory."""


def frames_of_samples(
    recipe: MapRecipe,
    source: str,
    samples_of: SamplesOf,
    *,
    about: Mapping[str, Any] | None = None,
    notes: Mapping[str, Any] | None = None,
    model_xml: str = "",
) -> list[EpisodeFrames]:
    """The episodes in one recording: one, or the pieces between its gaps.

    `source` names the recording in messages; `about`, `notes` and `model_xml` are added to every episode.

    Raises `RecordingError` for samples that cannot be right (`checked` of `samples`), channels that share no time,
    and, unless the recipe splits, a gap longer than it allows.
    """
    channels = [
        channel_of(name, entry, checked(samples_of(entry), name, entry), recipe.max_gap_s(name))
        for name, entry in recipe.entries.items()
    ]
    refuse_doubles(channels)
    start_ns, times = _grid(recipe.resample, source, channels)
    filled = [rows_of(channel, start_ns, times) for channel in channels]
    gaps = [gap for c, rows in zip(channels, filled, strict=True) for gap in gaps_of(c, rows, start_ns, times)]
    if gaps and recipe.resample.on_gap == "refuse":
        raise RecordingError(_refusal(gaps))
    pieces = _runs(np.logical_and.reduce([rows.valid for rows in filled]))
    kept = [piece for piece in pieces if len(piece) >= recipe.resample.min_frames]
    if not kept:
        raise RecordingError(
            f"{source}: its longest piece without a gap has {max(map(len, pieces), default=0)} rows, min_frames is "
            f"{recipe.resample.min_frames}; leave the recording out (--skip-bad), or allow a longer max_gap_s"
        )
    facts = {
        "pieces": len(kept),
        "dropped": [{"at_s": _short(times[p.start]), "rows": len(p)} for p in pieces if p not in kept],
        "gaps": [_gap_note(gap) for gap in gaps],
        "channels": {c.name: _channel_note(c, start_ns) for c in channels},
    }
    return [
        EpisodeFrames(
            source=source if len(pieces) == 1 else f"{source} from {times[piece.start]:.3f} s",
            fps=recipe.resample.fps,
            task=recipe.resample.task,
            **_features(channels, filled, piece),
            about={"robot": recipe.resample.robot, **(about or {})},
            notes={"start_s": _short(times[piece.start]), **facts, **(notes or {})},
            model_xml=model_xml,
        )
        for piece in kept
    ]


def _grid(recipe: ResampleRecipe, source: str, channels: list[Channel]) -> tuple[int, Float[np.ndarray, "T"]]:
    """Time of the first row [ns] and the times of all rows after it [s]."""
    late = max(channels, key=lambda c: c.samples.times_ns[0])
    ending = [c for c in channels if not c.entry.latched]
    # where every value is latched, the last message of all ends the episode
    early = min(ending, key=_last) if ending else max(channels, key=_last)
    start, end = int(late.samples.times_ns[0]), _last(early)
    if end < start:
        raise RecordingError(
            f"{source}: the topics share no time: {late.entry.topic} ({late.samples.clock} clock) begins "
            f"{(start - end) / 1e9:.3f} s after {early.entry.topic} ({early.samples.clock} clock) ends; if their "
            'clocks differ, set clock = "log" in [resample], else leave the recording out (--skip-bad)'
        )
    if (end - start) * recipe.fps > MOST_ROWS * 10**9:
        gaps = {c.entry.topic: resample.longest_interval(c.samples.seconds_after(start))[1] for c in channels}
        worst = max(gaps, key=lambda topic: gaps[topic])
        raise RecordingError(
            f"{source}: its stamps span {(end - start) / 1e9:.0f} s, more than {MOST_ROWS} rows, with "
            f"{gaps[worst]:.0f} s between two of {worst}; leave the recording out (--skip-bad), or, if the stamps are "
            'wrong, set clock = "log" in [resample]'
        )
    times = resample.rows_between(start, end, recipe.fps)
    if len(times) < 2:
        raise RecordingError(
            f"{source}: the mapped topics share {(end - start) / 1e9:.3f} s, from the first sample of "
            f"{late.entry.topic} to the last of {early.entry.topic}: {len(times)} row at {recipe.fps} Hz is no "
            "episode; leave the recording out (--skip-bad)"
        )
    return start, times


def _last(channel: Channel) -> int:
    return int(channel.samples.times_ns[-1])


def _refusal(gaps: list[Gap]) -> str:
    first = min(gaps, key=lambda gap: gap.at_s)
    samples, more = first.channel.samples, f" (and {len(gaps) - 1} more such gaps)" if len(gaps) > 1 else ""
    return (
        f"{samples.where} has nothing for {first.seconds:.3f} s from {samples.moment(first.sample)}, "
        f"{first.channel.max_gap_s:g} s are allowed{more}; leave the recording out (--skip-bad), set "
        f'on_gap = "split" in [resample], or allow more with max_gap_s in [map.{first.channel.name}]'
    )


def _gap_note(gap: Gap) -> dict[str, Any]:
    channel = gap.channel
    place = {"channel": channel.name, "topic": channel.entry.topic, "allowed_s": channel.max_gap_s}
    return {**place, "at_s": _short(gap.at_s), "seconds": _short(gap.seconds)}


def _channel_note(channel: Channel, start_ns: int) -> dict[str, Any]:
    """How a channel was sampled, for the report."""
    at, seconds = resample.longest_interval(channel.samples.seconds_after(start_ns))
    return {
        "topic": channel.entry.topic,
        "method": channel.method,
        "clock": channel.samples.clock,
        "samples": len(channel.samples.times_ns),
        "longest_interval_s": _short(seconds),
        "longest_at_s": _short((int(channel.samples.times_ns[at]) - start_ns) / 1e9),
    }


def _short(seconds: float) -> float:
    return round(float(seconds), 6)


def _runs(valid: Bool[np.ndarray, "T"]) -> list[range]:
    """The stretches of rows that are valid throughout."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8)))
    return [range(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def _features(channels: list[Channel], filled: list[Rows], piece: range) -> dict[str, Any]:
    """Columns, names, units and pictures of a piece: the entries of a feature joined in the recipe's order."""
    parts: dict[str, list[np.ndarray]] = {}
    names: dict[str, tuple[str, ...]] = {}
    units: dict[str, tuple[str, ...]] = {}
    pictures: dict[str, Pictures] = {}
    for channel, rows in zip(channels, filled, strict=True):
        feature, samples = channel.entry.feature, channel.samples
        if rows.values is None:
            assert samples.pictures is not None
            assert rows.index is not None
            taken = [samples.pictures.items[i] for i in rows.index[piece.start : piece.stop]]
            pictures[feature] = Pictures(taken, samples.pictures.decode)
            continue
        parts.setdefault(feature, []).append(rows.values[piece.start : piece.stop])
        names[feature] = names.get(feature, ()) + tuple(f"{channel.name}.{n}" for n in samples.names)
        units[feature] = units.get(feature, ()) + (UNITS[channel.entry.unit].si,) * len(samples.names)
    columns = {feature: _joined(some) for feature, some in parts.items()}
    return {"columns": columns, "names": names, "units": units, "pictures": pictures}


def _joined(columns: list[np.ndarray]) -> Shaped[np.ndarray, "T D"]:
    """Flags alone stay flags; numbers are float32, as LeRobot wants them."""
    joined = np.concatenate(columns, axis=1)
    return joined if joined.dtype == bool else joined.astype(np.float32)
