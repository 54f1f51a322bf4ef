"""The way back: recordings, HDF5 demonstrations and LeRobot datasets as MCAP files or as HDF5 of robomimic."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.dataset.lerobot_writer import INFO, OWN
from lfd.convert.frames import EpisodeFrames
from lfd.convert.hdf5.robomimic_export import export_episodes, export_frames
from lfd.convert.mcap_export import export_mcap
from lfd.convert.sources import HDF5, SourceRecipe, Unit, episode_in, hashes, units_of
from lfd.core.artifact import new_folder, write_manifest
from lfd.core.errors import InputError
from lfd.core.protocols import Progress, silent
from lfd.record.episode_writing import write_episode
from lfd.record.mcap_file import SUFFIX

FORMATS = ("mcap", "robomimic")
VALID = 0.1
"""Share of the episodes that robomimic validates on."""


@dataclass(frozen=True)
class Exported:
    """What an export wrote."""

    out: str
    episodes: int


def export(
    sources: Sequence[Path],
    out: Path,
    *,
    to: str,
    seed: int = 0,
    trust_rows: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Exported:
    """Write one LeRobot dataset, or recordings and HDF5 demonstrations, to the folder or HDF5 file `out`.

    `to` is `mcap`, a folder with a file for each episode, or `robomimic`, one HDF5 file of which a tenth of the
    episodes, drawn by `seed`, is for validation.

    Raises `InputError` for another format or for sources that are mixed, and what reading them raises.
    """
    if to not in FORMATS:
        raise InputError(f"cannot export to {to!r}; choose {' or '.join(FORMATS)}")
    datasets = [source for source in sources if (source / INFO).is_file()]
    if datasets and len(sources) > 1:
        raise InputError(f"{datasets[0]} is a dataset: export one at a time")
    if datasets:
        return _export_dataset(datasets[0], out, to, seed, overwrite, progress)
    recipe = SourceRecipe(where="export", trust_rows=trust_rows)
    units = units_of(sources, recipe)
    if to == "mcap":
        return _export_recordings(units, recipe, out, overwrite, progress)
    with progress("export", len(units)) as bar:

        def episodes() -> Iterator:
            for unit in units:
                yield episode_in(unit, recipe)
                bar.advance()

        done = export_episodes(episodes(), out, valid_fraction=VALID, seed=seed, overwrite=overwrite)
    return Exported(str(out), done.episodes)


def _export_dataset(dataset: Path, out: Path, to: str, seed: int, overwrite: bool, progress: Progress) -> Exported:
    if to == "mcap":
        return Exported(str(out), export_mcap(dataset, out, overwrite=overwrite, progress=progress))
    files = DatasetFiles(dataset)
    with progress("export", len(files)) as bar:

        def frames() -> Iterator[EpisodeFrames]:
            for index in range(len(files)):
                yield stored_frames(files, index)
                bar.advance()

        done = export_frames(frames(), out, valid_fraction=VALID, seed=seed, overwrite=overwrite)
    return Exported(str(out), done.episodes)


def stored_frames(files: DatasetFiles, index: int) -> EpisodeFrames:
    """An episode of a dataset as rows, without its pictures."""
    stored = files.read(index)
    columns = {name: rows for name, rows in stored.columns.items() if name not in OWN}
    about = {key: files.manifest[key] for key in ("robot", "controller", "task", "control_hz") if key in files.manifest}
    return EpisodeFrames(
        source=f"{files.root} episode {index}",
        fps=files.fps,
        task=stored.tasks[0],
        columns={name: rows if rows.dtype == bool else rows.astype(np.float32) for name, rows in columns.items()},
        names={name: files.names(name) for name in columns},
        units={name: files.units(name) for name in columns},
        about=about,
    )


def _export_recordings(
    units: Sequence[Unit], recipe: SourceRecipe, out: Path, overwrite: bool, progress: Progress
) -> Exported:
    """Write HDF5 demonstrations, which the simulator fills, as recordings."""
    if not any(unit.paths[0].suffix in HDF5 for unit in units):
        raise InputError("recordings are MCAP files already; export them with --to robomimic")
    with new_folder(out, overwrite=overwrite) as part, progress("export", len(units)) as bar:
        for index, unit in enumerate(units):
            write_episode(part / f"episode_{index:06d}{SUFFIX}", episode_in(unit, recipe))
            bar.advance()
        write_manifest(part, kind="recordings", recipe={}, parents=hashes(units), seed=0)
    return Exported(str(out), len(units))
