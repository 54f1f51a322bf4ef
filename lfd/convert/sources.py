"""What a dataset is made from: recordings of lfd, MCAP files of other programs, and HDF5 demonstrations.

A source is cut into units that can be read by themselves, wherever: a file, the files of one bag, a demonstration.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lfd.convert.dataset.video import VideoRecipe
from lfd.convert.features import ConvertRecipe, pieces_of_episode
from lfd.convert.foreign.bags import bags_in, frames_of_content, joined
from lfd.convert.foreign.mapping import MapRecipe, map_recipe
from lfd.convert.frames import EpisodeFrames
from lfd.core.artifact import sha256
from lfd.core.episode import Episode
from lfd.core.errors import RecipeError, RecordingError
from lfd.core.recipe import Table, build, load_toml
from lfd.record.episode_file import BEGIN, episode_of, recipe_in
from lfd.record.mcap_file import SUFFIX

TABLES = ("record", "convert", "resample", "map", "video")
HDF5 = (".hdf5", ".h5")


@dataclass(frozen=True, kw_only=True)
class SourceRecipe:
    """What a recipe says of turning sources into episodes; each kind of source needs its own tables."""

    where: str
    """The recipe's name in messages."""
    tables: Mapping[str, Table] = field(default_factory=dict)
    trust_rows: bool = False
    """Whether rows count where an HDF5 file's own numbers of them differ."""
    trust_total: bool = False
    """The same for the sum of all demonstrations alone."""

    @classmethod
    def load(cls, path: Path | None, *, trust_rows: bool = False) -> "SourceRecipe":
        """The recipe in a file; without one, each recording brings its own."""
        tables = {} if path is None else load_toml(path, TABLES)
        return cls(where=str(path or "the recipe"), tables=tables, trust_rows=trust_rows)

    @classmethod
    def kept(cls, manifest: Mapping[str, Any], where: str) -> "SourceRecipe":
        """The recipe that a dataset's manifest keeps."""
        recipe = manifest.get("recipe") or {}
        tables = {name: recipe[name] for name in TABLES if name in recipe}
        return cls(where=where, tables=tables, trust_rows=bool(manifest.get("trust_rows")), trust_total=True)

    def going_on(self, kept: "SourceRecipe") -> "SourceRecipe":
        """With the tables by which a dataset was made, for the episodes that are added to it.

        Raises `RecipeError` for a table that says something else than the dataset's.
        """
        for name, read in (
            ("convert", SourceRecipe.convert),
            ("map", SourceRecipe.mapping),
            ("video", SourceRecipe.video),
        ):
            if name in self.tables and name in kept.tables and read(self) != read(kept):
                raise RecipeError(
                    f"{self.where} [{name}] is not the one by which {kept.where} says that the dataset was made; leave "
                    "out --recipe to go on by that one, or make another dataset"
                )
        return replace(self, tables={**kept.tables, **self.tables}, trust_rows=self.trust_rows or kept.trust_rows)

    def completed(self, units: Sequence["Unit"]) -> "SourceRecipe":
        """With the tables that the first recording of lfd keeps, where the recipe has none of its own."""
        if "convert" in self.tables or self.is_mapping:
            return self
        for unit in units:
            kept = {} if unit.paths[0].suffix in HDF5 else recipe_in(unit.paths[0])
            if "convert" in kept:
                return replace(self, tables={**{name: kept[name] for name in TABLES if name in kept}, **self.tables})
        return self

    def check(self) -> None:
        """Raise `RecipeError` for a table that cannot be read."""
        if "convert" in self.tables:
            self.convert()
        if self.is_mapping:
            self.mapping()
        self.video()

    @property
    def is_mapping(self) -> bool:
        """Whether it maps the topics of another program."""
        return "map" in self.tables or "resample" in self.tables

    def mapping(self) -> MapRecipe:
        return map_recipe(self.tables, self.where)

    def convert(self) -> ConvertRecipe:
        if "convert" not in self.tables:
            raise RecipeError(
                f"{self.where} has no [convert] table, and no recording keeps one; name a recipe with --recipe"
            )
        return build(ConvertRecipe, self.tables["convert"], f"{self.where} [convert]")

    def video(self) -> VideoRecipe:
        return build(VideoRecipe, self.tables.get("video", {}), f"{self.where} [video]")


@dataclass(frozen=True)
class Unit:
    """A part of the sources that is read by itself."""

    paths: tuple[Path, ...]
    """The file, or the files of one bag."""
    demo: str = ""
    """Name of the demonstration in an HDF5 file."""

    def __str__(self) -> str:
        name = str(self.paths[0] if len(self.paths) == 1 else self.paths[0].parent)
        return f"{name} {self.demo}".rstrip()

    @property
    def key(self) -> str:
        """What it is called wherever the command runs."""
        return str(replace(self, paths=tuple(path.resolve() for path in self.paths)))

    @property
    def bytes(self) -> int:
        """Size of its files."""
        return sum(path.stat().st_size for path in self.paths)

    def packed(self) -> "PackedUnit":
        return PackedUnit(self, tuple(path.read_bytes() for path in self.paths))


@dataclass(frozen=True)
class PackedUnit:
    """A unit with the content of its files, to be sent to another machine."""

    unit: Unit
    contents: tuple[bytes, ...]

    @contextmanager
    def unpacked(self) -> Iterator[Unit]:
        """The unit with its files in a temporary folder."""
        with TemporaryDirectory() as folder:
            paths = tuple(Path(folder) / path.name for path in self.unit.paths)
            for path, content in zip(paths, self.contents, strict=True):
                path.write_bytes(content)
            yield replace(self.unit, paths=paths)

    def named(self, text: str, here: Unit) -> str:
        """A text about the unpacked unit `here` with the folder that its files came from."""
        return text.replace(str(here.paths[0].parent), str(self.unit.paths[0].parent))


def units_of(sources: Sequence[Path], recipe: SourceRecipe) -> list[Unit]:
    """The units of files and folders, folders in the order of names; a file that is given twice counts once.

    Raises `RecordingError` when a source does not exist or holds nothing that can be converted.
    """
    found: dict[tuple[Any, ...], Unit] = {}
    for source in sources:
        for unit in _units_in(source, recipe):
            found[*(path.resolve() for path in unit.paths), unit.demo] = unit
    return list(found.values())


def _units_in(source: Path, recipe: SourceRecipe) -> Iterator[Unit]:
    if not source.exists():
        raise RecordingError(f"no recording {source}; `lfd record RECIPE --out {source}` makes some")
    inside = sorted(source.rglob("*")) if source.is_dir() else [source]
    files = [path for path in inside if path.suffix in HDF5]
    for file in files:
        yield from _demos_in(file, recipe)
    if not files or any(path.suffix == SUFFIX for path in inside):
        yield from (Unit(bag) for bag in bags_in([source]))


def _demos_in(file: Path, recipe: SourceRecipe) -> Iterator[Unit]:
    """The demonstrations of an HDF5 file; one that cannot be read is a unit that will say so."""
    try:
        demos = _hdf5(file, recipe).demos
    except RecordingError:
        demos = ("",)
    yield from (Unit((file,), demo) for demo in demos)


def _hdf5(file: Path, recipe: SourceRecipe) -> Any:
    """What an HDF5 file says of its demonstrations (`lfd.convert.hdf5.demo_file.DemoFile`)."""
    from lfd.convert.hdf5.demo_file import read_file

    return read_file(file, trust_rows=recipe.trust_rows or recipe.trust_total)


def frames_of(unit: Unit, recipe: SourceRecipe) -> list[EpisodeFrames]:
    """The episodes of a unit: none, when the recipe leaves its failure out.

    Raises `InputError` for what cannot be read, or not be converted.
    """
    if unit.paths[0].suffix in HDF5:
        return _frames_of_demo(unit, recipe)
    content = joined(unit.paths)
    if BEGIN not in content.metadata:
        if not recipe.is_mapping:
            raise RecipeError(
                f"{unit} is no recording of lfd: it has no metadata {BEGIN!r}. Name a recipe with [resample] and "
                f"[map.NAME] tables with --recipe; `lfd info {unit.paths[0]}` lists the topics"
            )
        return frames_of_content(content, str(unit), recipe.mapping())
    episode = episode_of(content, unit.paths[0], with_states=False)
    convert = recipe.convert()
    if not (convert.failures or episode.success):
        return []
    return pieces_of_episode(episode, convert, str(unit))


def _frames_of_demo(unit: Unit, recipe: SourceRecipe) -> list[EpisodeFrames]:
    from lfd.convert.hdf5.stored_samples import frames_of_demo

    file = _hdf5(unit.paths[0], recipe)
    if recipe.is_mapping:
        return frames_of_demo(file, unit.demo, recipe.mapping(), trust_rows=recipe.trust_rows)
    convert, replayed = recipe.convert(), _replayed(unit, recipe)
    if not (convert.failures or replayed.episode.success):
        return []
    return pieces_of_episode(replayed.episode, convert, str(unit), notes=asdict(replayed.deviation))


def _replayed(unit: Unit, recipe: SourceRecipe) -> Any:
    """A demonstration that went through the simulator (`lfd.convert.hdf5.replay.Replayed`)."""
    from lfd.convert.hdf5.demo_file import read_demo
    from lfd.convert.hdf5.replay import replay_demo

    file = _hdf5(unit.paths[0], recipe)
    return replay_demo(file, read_demo(file, unit.demo, obs=(), trust_rows=recipe.trust_rows))


def episode_in(unit: Unit, recipe: SourceRecipe) -> Episode:
    """The episode of a recording of lfd, or of a demonstration, which the simulator fills."""
    if unit.paths[0].suffix in HDF5:
        return _replayed(unit, recipe).episode
    return episode_of(joined(unit.paths), unit.paths[0])


def hashes(units: Sequence[Unit]) -> dict[str, str]:
    """Path of every file to its hash."""
    return {str(path): sha256(path) for path in dict.fromkeys(path for unit in units for path in unit.paths)}
