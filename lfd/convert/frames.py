"""An episode on its way into a dataset: rows at one rate, by LeRobot feature, whatever source they came from."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lfd.core.errors import DatasetError


@dataclass(frozen=True)
class Pictures:
    """Pictures of one camera, decoded one at a time when they are asked for."""

    items: Sequence[bytes]
    """The pictures as they were recorded."""
    decode: Callable[[bytes], UInt8[np.ndarray, "H W 3"]]
    """From an item to RGB."""

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, row: int) -> UInt8[np.ndarray, "H W 3"]:
        return self.decode(self.items[row])

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        return map(self.decode, self.items)


@dataclass(frozen=True, kw_only=True)
class EpisodeFrames:
    """The T rows of an episode, validated when made.

    Raises `DatasetError` when there are none, when lengths differ, or when a number is not finite.
    """

    source: str
    """Where it came from, as messages name it: `a.mcap`, or `demo.hdf5 demo_3`."""
    fps: int
    """Rows a second [Hz]; row t stands at t / fps."""
    task: str
    """What the robot is told to do."""
    columns: Mapping[str, np.ndarray]
    """Feature to its T rows, shape (T, D): float32, or bool for flags."""
    names: Mapping[str, tuple[str, ...]]
    """Feature to the names of its D components."""
    units: Mapping[str, tuple[str, ...]]
    """Feature to the units of its D components."""
    pictures: Mapping[str, Pictures] = field(default_factory=dict)
    """Feature (`observation.images.NAME`) to its T pictures."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Facts that all episodes of a dataset share: robot, controller, task. Kept in its manifest."""
    notes: Mapping[str, Any] = field(default_factory=dict)
    """Facts of this episode for the report: whether it was recovered, how far its replay deviates, gaps."""
    recipe: Mapping[str, Any] = field(default_factory=dict)
    """The tables by which it was made, as its dataset's manifest keeps them."""
    model_xml: str = ""
    """The MuJoCo model, where there is one."""

    def __post_init__(self) -> None:
        lengths = {name: len(rows) for name, rows in (*self.columns.items(), *self.pictures.items())}
        if not lengths or max(lengths.values()) == 0:
            raise DatasetError(f"{self.source}: the episode has no rows; leave it out")
        if len(set(lengths.values())) > 1:
            raise DatasetError(f"{self.source}: features have different numbers of rows: {lengths}")
        for name, rows in self.columns.items():
            if rows.shape[1:] != (len(self.names[name]),):
                raise DatasetError(f"{self.source}: {name} has rows of {rows.shape[1:]}, names {self.names[name]}")
            finite = np.isfinite(rows).all(axis=1)
            if not finite.all():
                at = int(np.argmin(finite))
                raise DatasetError(f"{self.source}: {name} is not finite in row {at} ({at / self.fps:.3f} s)")

    def __len__(self) -> int:
        """Number of rows T."""
        return len(next(iter((*self.columns.values(), *self.pictures.values()))))
