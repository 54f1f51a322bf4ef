"""What one channel of a source measured, at its own times, and whether that can be true.

Every source (an MCAP topic, a data set of an HDF5 demonstration) gives `Samples`; what follows does not know where
they came from.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int64

from lfd.convert.foreign.mapping import QUATERNION, MapEntry
from lfd.convert.foreign.units import UNITS, suspicion
from lfd.convert.frames import Pictures
from lfd.core.errors import RecordingError

UNIT_NORM = 1e-2
"""How far the length of a quaternion may be from 1."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """N samples of one channel: numbers, or pictures."""

    where: str
    """Where they came from, as messages name it: `bag.mcap, topic /joint_states`."""
    times_ns: Int64[np.ndarray, "N"]
    """When they were measured [ns], on a clock that all channels of the source share."""
    values: Float[np.ndarray, "N D"] | Bool[np.ndarray, "N D"] | None = None
    """The numbers, as the source has them; none where there are pictures."""
    names: tuple[str, ...] = ()
    """Names of the D components; none where the source gives none."""
    renamed: bool = False
    """Whether the names are the recipe's, given to all numbers of a field that has none."""
    pictures: Pictures | None = None
    """The N pictures."""
    unit: str = ""
    """Unit by the source's own word, in the words of `lfd.convert.foreign.units`; empty where it says nothing."""
    dimensions: tuple[str, ...] = ()
    """What the numbers may be by definition of their type, such as angle; none where it says nothing."""
    frames: Mapping[str, int] = field(default_factory=dict)
    """Frame by the source's own word, to the first sample that says so."""
    clock: str = "stored"
    """Which clock `times_ns` are of, for the report: header, log, stored."""

    def moment(self, index: int) -> str:
        """The time of a sample, for messages: since the first, and as it is stamped."""
        stamp = int(self.times_ns[index])
        since = (stamp - int(self.times_ns[0])) / 1e9
        sign, stamp = ("-" if stamp < 0 else ""), abs(stamp)
        return f"{since:.3f} s after its first sample (stamp {sign}{stamp // 10**9}.{stamp % 10**9:09d})"

    def seconds_after(self, start_ns: int) -> Float[np.ndarray, "N"]:
        """Times [s] since `start_ns`; the difference is taken in nanoseconds, so that no precision is lost."""
        return (self.times_ns - start_ns) / 1e9


def checked(samples: Samples, name: str, entry: MapEntry) -> Samples:
    """The samples of `[map.NAME]` with the components that it picks, in SI units.

    Raises `RecordingError` for no samples, stamps that jump back or repeat, numbers that are not finite, components
    that do not exist, pictures where numbers should be or the reverse, a unit or frame that contradicts the source.
    """
    if not len(samples.times_ns):
        raise RecordingError(f"{samples.where} has no messages; leave the recording out or [map.{name}]")
    _check_clock(samples)
    _check_frame(samples, name, entry)
    if entry.is_picture:
        if samples.pictures is None:
            raise RecordingError(
                f"{samples.where} holds numbers, [map.{name}] makes the pictures {entry.feature} of it; "
                "choose another topic, or a feature such as observation.state"
            )
        return samples
    if samples.values is None:
        raise RecordingError(
            f"{samples.where} holds pictures, [map.{name}] puts them into {entry.feature}; "
            f'write feature = "observation.images.{name}"'
        )
    _check_finite(samples)
    if entry.check_unit:
        _check_unit(samples, name, entry)
    picked = _picked(samples, name, entry)
    values = picked.values
    assert values is not None
    if entry.check_unit:
        _check_sizes(picked, name, entry)
    factor = UNITS[entry.unit].factor
    return replace(picked, values=values if values.dtype == bool or factor == 1.0 else values * factor)


def _check_clock(samples: Samples) -> None:
    steps = np.diff(samples.times_ns)
    if (steps > 0).all():
        return
    at = int(np.argmax(steps <= 0)) + 1
    cure = "leave the recording out (--skip-bad)"
    if samples.clock == "header":
        cure += ', or take the log times with clock = "log" in [resample]'
    if steps[at - 1] == 0:
        raise RecordingError(
            f"{samples.where}: samples {at - 1} and {at} have the same {samples.clock} stamp, "
            f"{samples.moment(at)}; {cure}"
        )
    raise RecordingError(
        f"{samples.where}: the {samples.clock} clock jumps back by {-steps[at - 1] / 1e9:.6g} s at sample {at}, "
        f"{samples.moment(at)}; {cure}"
    )


def _check_frame(samples: Samples, name: str, entry: MapEntry) -> None:
    said = {frame: at for frame, at in samples.frames.items() if frame}
    if entry.frame:
        for frame, at in said.items():
            if frame != entry.frame.removeprefix("/"):
                raise RecordingError(
                    f"{samples.where} is in frame {frame!r} at {samples.moment(at)}, [map.{name}] declares "
                    f"{entry.frame!r}; correct frame, or choose the topic that is in {entry.frame!r}"
                )
    elif len(said) > 1:
        frame, at = max(said.items(), key=lambda item: item[1])
        raise RecordingError(
            f"{samples.where} changes its frame to {frame!r} at {samples.moment(at)}, before it was "
            f"{', '.join(repr(f) for f in said if f != frame)}; one channel is in one frame: leave the recording out"
        )


def _check_finite(samples: Samples) -> None:
    assert samples.values is not None
    finite = np.isfinite(samples.values).all(axis=1)
    if not finite.all():
        at = int(np.argmin(finite))
        component = int(np.argmin(np.isfinite(samples.values[at])))
        called = samples.names[component] if samples.names else f"component {component}"
        raise RecordingError(
            f"{samples.where}: {called} is {samples.values[at, component]} in sample {at}, {samples.moment(at)}; "
            "leave the recording out (--skip-bad)"
        )


def _check_unit(samples: Samples, name: str, entry: MapEntry) -> None:
    declared = UNITS[entry.unit]
    cure = f"correct unit, or, if you know better, add check_unit = false to [map.{name}]"
    if samples.dimensions and declared.dimension not in samples.dimensions:
        known = " or ".join(f"{d} ({_si(d)})" for d in samples.dimensions)
        raise RecordingError(
            f"{samples.where} is {known} by definition, [map.{name}] declares {entry.unit!r} "
            f"({declared.dimension}); {cure}"
        )
    said = UNITS.get(samples.unit)
    if said is None or samples.dimensions:  # a type's definition knows more than a word beside the topic
        return
    if (said.si, said.factor) != (declared.si, declared.factor):
        raise RecordingError(
            f"{samples.where} has the unit {samples.unit!r} by its own word, "
            f"[map.{name}] declares {entry.unit!r}; {cure}"
        )


def _si(dimension: str) -> str:
    return next(unit.si for unit in UNITS.values() if unit.dimension == dimension)


def _check_sizes(samples: Samples, name: str, entry: MapEntry) -> None:
    assert samples.values is not None
    found = suspicion(samples.values.astype(float), entry.unit, absolute=bool(samples.dimensions))
    if found is not None:
        at, why, better = found
        raise RecordingError(
            f"{samples.where}, declared in {entry.unit} by [map.{name}]: {why}, see {samples.moment(at)}; "
            f"write unit = {better!r}, or, if they are right, add check_unit = false"
        )


def _picked(samples: Samples, name: str, entry: MapEntry) -> Samples:
    """The components that the entry asks for, or with the names that it gives."""
    values, wanted = samples.values, entry.components
    assert values is not None
    size = values.shape[1]
    if not samples.names:
        names = wanted or _usual_names(size, entry)
        if len(names) != size:
            raise RecordingError(
                f"{samples.where} has {size} numbers without names, [map.{name}] components gives "
                f"{len(names)} names: {', '.join(names)}; give {size}, or take a part such as "
                f"{entry.field or 'data'}[0:{len(names)}]"
            )
        return replace(samples, names=names, renamed=True)
    for component in wanted:
        if component not in samples.names:
            raise RecordingError(
                f"{samples.where} has no component {component!r}, which [map.{name}] wants; "
                f"it has {', '.join(samples.names)}"
            )
    columns = [samples.names.index(component) for component in wanted or samples.names]
    return replace(samples, values=values[:, columns], names=tuple(samples.names[c] for c in columns))


def _usual_names(size: int, entry: MapEntry) -> tuple[str, ...]:
    """What numbers without names are called: a single one like its field, several by their place."""
    last = entry.field.rpartition(".")[2]
    return (last,) if size == 1 and last else tuple(map(str, range(size)))


def is_quaternion(samples: Samples) -> bool:
    """Whether the components are w, x, y and z, in whichever order."""
    return len(samples.names) == 4 and set(samples.names) == set(QUATERNION)


def unit_quaternions(samples: Samples, name: str) -> Float[np.ndarray, "N 4"]:
    """The values, which must be quaternions, of length exactly 1.

    Raises `RecordingError` when they are something else.
    """
    values = samples.values
    if values is None or not is_quaternion(samples):
        raise RecordingError(
            f"{samples.where} has the components {', '.join(samples.names)}, which are no quaternion; "
            f'set method = "linear" in [map.{name}]'
        )
    lengths = np.linalg.norm(values, axis=1)
    at = int(np.abs(lengths - 1).argmax())
    if abs(lengths[at] - 1) > UNIT_NORM:
        raise RecordingError(
            f"{samples.where}: the quaternion of sample {at} has length {lengths[at]:.4g} instead of 1, "
            f'{samples.moment(at)}; set method = "linear" in [map.{name}] if it is no rotation'
        )
    return values / lengths[:, None]
