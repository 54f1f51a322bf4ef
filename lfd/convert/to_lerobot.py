"""The convert stage: recordings, ROS 2 bags and HDF5 demonstrations become one LeRobot v3 dataset, which may grow."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lfd.convert.dataset.lerobot_writer import INFO, DatasetWriter, dataset_writer
from lfd.convert.prepared import PreparedEpisode, prepare
from lfd.convert.sources import PackedUnit, SourceRecipe, Unit, frames_of, hashes, units_of
from lfd.convert.verify import Placed, verify_placed
from lfd.core.artifact import heal, new_folder, read_manifest, write_manifest
from lfd.core.errors import DatasetError, EpisodeError, InputError, OutputError, RecordingError
from lfd.core.processes import ProcessMap, cores, in_order
from lfd.core.protocols import Progress, UnitMap, silent

MODEL = "model.xml"
SKIPPABLE = (RecordingError, EpisodeError, DatasetError)
"""What `skip_bad` may leave out: faults of a recording, not of the recipe."""
WORTH_PROCESSES = 32 * 2**20
"""Sources of so many bytes are read in processes of their own; fewer are read before a process has started."""
SHARED = ("robot", "controller", "task", "control_hz")
"""What a manifest keeps of that which all episodes share; the task may differ."""
AHEAD = 8
"""Units for each CPU of a cluster that are sent there at once; their results wait in memory for their turn."""


@dataclass(frozen=True)
class Converted:
    """What a run of the convert stage did."""

    episodes: int
    """Episodes that were added."""
    frames: int
    """Frames that were added."""
    compared: int
    """Numbers read back from the dataset and compared with the recordings."""
    skipped: tuple[str, ...] = ()
    """What was left out, and why."""
    left_out: int = 0
    """Recordings that the recipe leaves out, because they failed."""
    notes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Episodes of which there is something to say: recovered, replayed with a deviation, cut at gaps."""


def convert(
    sources: Sequence[Path],
    out: Path,
    *,
    recipe: SourceRecipe | None = None,
    append: bool = False,
    skip_bad: bool = False,
    jobs: int | None = None,
    cluster: UnitMap | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Converted:
    """Convert files, or folders of them, into the dataset folder `out`, or `append` them to the one that is there.

    Without a `recipe`, that of the dataset that grows is used, or else the `[convert]` table kept in each recording.
    Units are read by `jobs` processes, by as many as there are cores where it is worth it, or on a `cluster`; the
    dataset does not depend on that. It is read back and compared with its sources before it appears under its name:
    after an interruption there is the old one or none.

    Raises `RecordingError` or `EpisodeError` for a source that cannot be read and `DatasetError` when episodes do not
    go together, unless `skip_bad` leaves them out; `OutputError` when `out` exists, `VerificationError` when the
    dataset differs.
    """
    recipe = recipe or SourceRecipe(where="the recipe")
    recipe = replace(recipe, trust_total=skip_bad)
    recipe.check()
    manifest: Mapping[str, Any] = {}
    if append:
        heal(out)
        if not (out / INFO).is_file():
            raise OutputError(f"{out} is no dataset that could grow; leave out --append to make one")
        manifest = read_manifest(out) or {}
        recipe = recipe.going_on(SourceRecipe.kept(manifest, f"{out} manifest.json"))
    units = units_of(sources, recipe)
    recipe = recipe.completed(units)
    run = cluster or _processes(units, jobs)
    _refuse_known(units, manifest)
    tally = _Tally(skip_bad, manifest)
    with new_folder(out, overwrite=overwrite, grow=append) as part:
        with dataset_writer(part) as writer, progress("convert", len(units)) as bar:
            before = writer.episodes, writer.frames
            for unit, episodes, error in _read(units, recipe, run):
                tally.take(writer, unit, episodes, error, part)
                bar.advance(note=f"{writer.frames - before[1]} frames")
            if writer.episodes == before[0]:
                reasons = "; ".join(tally.skipped.values()) or "all are failures"
                raise DatasetError(f"not one episode is left to convert: {reasons}")
        _describe(part, recipe, tally, manifest)
        compared = verify_placed(part, tally.placed, recipe, _processes(units, jobs), progress)
    return Converted(
        episodes=writer.episodes - before[0],
        frames=writer.frames - before[1],
        compared=compared,
        skipped=tuple(tally.skipped.values()),
        left_out=tally.left_out,
        notes=tally.notes,
    )


def _processes(units: Sequence[Unit], jobs: int | None) -> ProcessMap:
    if jobs is not None:
        return ProcessMap(jobs)
    return ProcessMap(cores() if sum(unit.bytes for unit in units) >= WORTH_PROCESSES else 1)


def _read(
    units: Sequence[Unit], recipe: SourceRecipe, run: UnitMap
) -> Iterator[tuple[Unit, list[PreparedEpisode], InputError | None]]:
    """The episodes of every unit in order, or what is wrong with it."""
    size = len(units) if isinstance(run, ProcessMap) else max(1, AHEAD * run.cpus)
    for begin in range(0, len(units), size):
        some = units[begin : begin + size]
        if isinstance(run, ProcessMap):
            results = in_order(run(_prepare_unit, recipe, some))
        else:
            results = in_order(run(_prepare_sent, recipe, [unit.packed() for unit in some]))
        for unit, (episodes, error) in zip(some, results, strict=True):
            yield unit, episodes, error


def _prepare_unit(recipe: SourceRecipe, unit: Unit) -> tuple[list[PreparedEpisode], InputError | None]:
    """A worker's part of a conversion."""
    try:
        video = recipe.video()
        return [prepare(frames, video) for frames in frames_of(unit, recipe)], None
    except SKIPPABLE as error:
        return [], error


def _prepare_sent(recipe: SourceRecipe, unit: PackedUnit) -> tuple[list[PreparedEpisode], InputError | None]:
    """The same on another machine, to which the unit's files were sent; messages name those on the first one."""
    with unit.unpacked() as here:
        episodes, error = _prepare_unit(recipe, here)
        named = None if error is None else type(error)(unit.named(str(error), here))
        return [replace(episode, source=unit.named(episode.source, here)) for episode in episodes], named


class _Tally:
    """What became of the units so far."""

    def __init__(self, skip_bad: bool, manifest: Mapping[str, Any]):
        """`manifest` is that of the dataset that grows."""
        self._skip_bad = skip_bad
        self.placed: list[Placed] = []
        """Units that were taken, each with the number of its first episode."""
        self.skipped: dict[str, str] = {}
        self.left_out = 0
        self.notes: dict[str, Mapping[str, Any]] = {}
        self.about: dict[str, Any] = {key: manifest[key] for key in SHARED if key in manifest}
        self.recipe: dict[str, Any] = {}
        self.units: dict[str, list[str]] = dict(manifest.get("units", {}))

    def take(
        self,
        writer: DatasetWriter,
        unit: Unit,
        episodes: Sequence[PreparedEpisode],
        error: InputError | None,
        root: Path,
    ) -> None:
        """Append a unit's episodes, or all of them are left out."""
        try:
            if error is not None:
                raise error
            for episode in episodes:
                self._check_goes_with(episode)
                writer.check_fits(episode)
        except SKIPPABLE as wrong:
            if not self._skip_bad:
                raise
            self.skipped[unit.key] = str(wrong)
            return
        if not episodes:
            self.left_out += 1
            return
        self.placed.append((unit, writer.episodes))
        for episode in episodes:
            self.about = self.about or dict(episode.about)
            self.recipe = self.recipe or dict(episode.recipe)
            self.units = self.units or {name: list(units) for name, units in episode.units.items()}
            if episode.notes:
                self.notes[f"{writer.episodes} {episode.source}"] = episode.notes
            if episode.model_xml and not (root / MODEL).is_file():
                (root / MODEL).write_text(episode.model_xml, encoding="utf-8")
            writer.add(episode)

    def _check_goes_with(self, episode: PreparedEpisode) -> None:
        for key, there in self.about.items():
            here = episode.about.get(key)
            if key != "task" and here != there:
                raise DatasetError(
                    f"{episode.source} has {key} {here}, the episodes before it have {there}; convert them into "
                    "datasets of their own"
                )
        for name, there in self.units.items():
            here = list(episode.units.get(name, there))
            if here != there:
                raise DatasetError(f"{episode.source} has {name} in {here}, the episodes before it in {there}")


def _refuse_known(units: Sequence[Unit], manifest: Mapping[str, Any]) -> None:
    """Refuse what is in a dataset already, by whatever name it is known there."""
    known = {digest: path for path, digest in manifest.get("parents", {}).items()}
    if not known:
        return
    for path, digest in hashes(units).items():
        if digest in known:
            was = "" if known[digest] == path else f" as {known[digest]}"
            raise DatasetError(f"{path} is in the dataset already{was}; give only what is new")
    there = {str(Path(path).resolve()) for path in known.values()}
    for path in (path for unit in units for path in unit.paths):
        if str(path.resolve()) in there:
            raise DatasetError(f"{path} is in the dataset already, and has changed since; convert all sources anew")


def _describe(root: Path, recipe: SourceRecipe, tally: _Tally, manifest: Mapping[str, Any]) -> None:
    """Write the manifest: recipe, sources by hash, units, and what was left out."""
    tables = tally.recipe | (manifest.get("recipe") or {}) | dict(recipe.tables)
    taken = {unit.key for unit, _ in tally.placed}
    skipped = {key: why for key, why in manifest.get("skipped", {}).items() if key not in taken} | tally.skipped
    write_manifest(
        root,
        kind="dataset",
        recipe=tables,
        parents={**manifest.get("parents", {}), **hashes([unit for unit, _ in tally.placed])},
        seed=tables.get("record", {}).get("seed", 0),
        **tally.about,
        trust_rows=recipe.trust_rows,
        units=tally.units,
        skipped=skipped,
        notes={**manifest.get("notes", {}), **tally.notes},
    )
