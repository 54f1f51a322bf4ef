"""The recipe for recordings of other programs: which of their channels become which LeRobot features.

`[resample]` says how clocks become one; each `[map.NAME]` takes one field of one topic. The entries that name the
same feature make it up, in the order of the recipe; its components are called `NAME.component`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from math import inf
from typing import Any

from lfd.convert.foreign.field_path import Step, meet, parse_field
from lfd.convert.foreign.units import UNITS
from lfd.core.errors import RecipeError, UnknownName
from lfd.core.recipe import build

TABLES = ("resample", "map")
PICTURES = "observation.images."
PICTURE_UNIT = "1/255"
METHODS = ("hold", "linear", "slerp", "nearest")
PICTURE_METHODS = ("nearest", "hold")
RESERVED = ("timestamp", "frame_index", "episode_index", "index", "task_index", "task")
QUATERNION = ("w", "x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class ResampleRecipe:
    """The `[resample]` table of a file in `datasets/`."""

    fps: int
    """Rows a second of the dataset [Hz]."""
    robot: str
    """LeRobot's robot_type."""
    max_gap_s: float
    """Longest time without a message that may be bridged [s]."""
    task: str = ""
    """What the robot is told to do, in words."""
    task_topic: str = ""
    """Topic whose first message, a std_msgs/String, says it in the place of `task`."""
    clock: str = "header"
    """Time of a message: `header`, its own stamp (or the log time, where that is 0), or `log`, when it was logged."""
    on_gap: str = "refuse"
    """What a longer gap does: `refuse` the recording, or `split` it into episodes."""
    min_frames: int = 2
    """Rows that an episode needs; shorter pieces of a split recording are dropped and listed."""

    def check(self, where: str) -> None:
        _one_of(self.clock, ("header", "log"), f"clock in {where}:")
        _one_of(self.on_gap, ("refuse", "split"), f"on_gap in {where}:")
        if self.fps < 1:
            raise RecipeError(f"{where} fps = {self.fps}: expected at least 1")
        if not 0 < self.max_gap_s < inf:
            raise RecipeError(f"{where} max_gap_s = {self.max_gap_s}: expected seconds above 0")
        if self.min_frames < 2:
            raise RecipeError(f"{where} min_frames = {self.min_frames}: an episode has at least 2 rows")
        if not self.robot.strip():
            raise RecipeError(f"{where} robot is empty")
        if bool(self.task.strip()) == bool(self.task_topic):
            raise RecipeError(f"{where} needs task, the instruction in words, or task_topic, a topic that says it")


@dataclass(frozen=True, kw_only=True)
class MapEntry:
    """A `[map.NAME]` table of a file in `datasets/`."""

    topic: str
    """Topic of an MCAP file, or name of a data set below `obs` of an HDF5 demonstration."""
    field: str = ""
    """Path in the message, such as `position`, `pose.orientation` or `data[0:7]`; nothing is the whole message."""
    components: tuple[str, ...] = ()
    """Names to pick, in this order (joints, axes, labels); for numbers without names, the names to give them."""
    feature: str
    """LeRobot feature to become part of: observation.state, action, or observation.images.NAME for pictures."""
    unit: str = ""
    """Unit of the numbers in the source; the rows are in SI. Pictures have none."""
    frame: str = ""
    """Frame in which they are expressed; compared with the one in the messages where they name one."""
    method: str = ""
    """Value between samples: hold, linear, slerp, nearest. Unless given: slerp for quaternions, hold for actions and
    flags, nearest for pictures, linear for the rest."""
    max_gap_s: float = 0.0
    """Longest gap of this channel [s], where that of [resample] does not suit it."""
    latched: bool = False
    """Whether a value holds until the next one, however late: the channel has no gaps and does not end an episode."""
    check_unit: bool = True
    """Whether the unit is compared with the type's definition, the channel's metadata and the sizes of the numbers."""

    @property
    def is_picture(self) -> bool:
        """Whether it becomes pictures."""
        return self.feature.startswith(PICTURES)

    def path(self, where: str) -> tuple[Step, ...]:
        """`field` in steps."""
        return parse_field(self.field, where)

    def check(self, where: str) -> None:
        if not self.topic:
            raise RecipeError(f"{where} topic is empty; `lfd info RECORDING` lists the topics")
        self.path(where)
        if self.method:
            _one_of(self.method, METHODS, f"method in {where}:")
        if not 0 <= self.max_gap_s < inf:
            raise RecipeError(f"{where} max_gap_s = {self.max_gap_s}: expected seconds above 0")
        if self.latched and self.method not in ("", "hold"):
            raise RecipeError(f"{where} method = {self.method!r}: a latched value is held; leave out one of the two")
        if self.feature in ("", PICTURES, *RESERVED) or "/" in self.feature:
            raise RecipeError(
                f"{where} feature = {self.feature!r} cannot be a feature; write observation.state, "
                f"observation.environment_state, action or {PICTURES}NAME"
            )
        if len(set(self.components)) != len(self.components):
            raise RecipeError(f"{where} components: a name is listed twice: {', '.join(self.components)}")
        (self._check_picture if self.is_picture else self._check_numbers)(where)

    def _check_picture(self, where: str) -> None:
        if self.method:
            _one_of(self.method, PICTURE_METHODS, f"method for pictures in {where}:")
        if self.unit not in ("", PICTURE_UNIT):
            raise RecipeError(f"{where} unit = {self.unit!r}: pictures have no unit; leave it out")
        if self.components:
            raise RecipeError(f"{where} components: pictures have none; leave it out")

    def _check_numbers(self, where: str) -> None:
        if not self.unit:
            raise RecipeError(f"{where} lacks unit: say in which unit the source has it, such as {', '.join(UNITS)}")
        if self.unit not in UNITS:
            raise UnknownName(f"unit in {where}:", self.unit, UNITS)
        if self.method == "slerp" and self.components and set(self.components) != set(QUATERNION):
            raise RecipeError(
                f"{where} method = 'slerp' turns quaternions, with the components w, x, y and z, "
                f"not {', '.join(self.components)}; use linear"
            )


@dataclass(frozen=True, kw_only=True)
class MapRecipe:
    """Both tables together."""

    resample: ResampleRecipe
    entries: Mapping[str, MapEntry]
    """Name of a channel to what it is made of, in the order of the recipe."""

    def max_gap_s(self, name: str) -> float:
        """Longest gap of a channel [s]."""
        entry = self.entries[name]
        return inf if entry.latched else entry.max_gap_s or self.resample.max_gap_s


def map_recipe(tables: Mapping[str, Any], where: str) -> MapRecipe:
    """The mapping in the tables of the recipe file `where`.

    Raises `RecipeError` for a table that is missing, a value that cannot be, a channel mapped twice, or pictures
    mixed with something else in a feature, and `UnknownName` for a key, unit or method that does not exist.
    """
    for table in TABLES:
        if not tables.get(table):
            example = {"resample": "[resample]", "map": "[map.NAME]"}[table]
            raise RecipeError(f"{where} has no {example} table; recordings of other programs need one")
    entries = {}
    for name, table in tables["map"].items():
        if not isinstance(table, dict):
            raise RecipeError(f"{where} [map] {name!r} is no table; write it as [map.{name}]")
        entries[name] = build(MapEntry, table, f"{where} [map.{name}]")
    _refuse_doubles(entries, where)
    return MapRecipe(resample=build(ResampleRecipe, tables["resample"], f"{where} [resample]"), entries=entries)


def _refuse_doubles(entries: Mapping[str, MapEntry], where: str) -> None:
    """No number of a source stands in two features, and a feature of pictures has one entry."""
    for (first, a), (second, b) in combinations(entries.items(), 2):
        both = f"{where} [map.{first}] and [map.{second}]"
        if a.is_picture and a.feature == b.feature:
            raise RecipeError(f"{both} both make {a.feature}, which holds the pictures of one camera")
        if a.topic == b.topic and any(meet(x, y) for x in _leaves(a, both) for y in _leaves(b, both)):
            raise RecipeError(
                f"{both} both map {a.topic} {a.field or b.field}; map a channel once, or give components that differ"
            )


def _leaves(entry: MapEntry, where: str) -> list[tuple[Step, ...]]:
    path = entry.path(where)
    if path and isinstance(path[-1], slice):  # its components may be names that it gives
        return [path]
    return [(*path, name) for name in entry.components] or [path]


def _one_of(given: str, known: tuple[str, ...], kind: str) -> None:
    if given not in known:
        raise UnknownName(kind, given, known)
