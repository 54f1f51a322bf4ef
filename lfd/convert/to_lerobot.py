"""The convert stage: recordings of one task and robot become one LeRobot v3 dataset."""

import os
from collections.abc import Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfd.convert.features import ConvertRecipe, columns_of, features_of
from lfd.core.artifact import new_folder, sha256, write_manifest
from lfd.core.episode import Episode
from lfd.core.errors import DatasetError, RecipeError, VerificationError
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import as_table, build
from lfd.record.episode_file import read_episode, recordings_in

MODEL = "model.xml"
CLOCK_TOLERANCE_S = 1e-4  # LeRobot's own


@dataclass(frozen=True)
class Converted:
    """What a run of the convert stage did."""

    episodes: int
    frames: int
    compared: int
    """Numbers read back from the dataset and compared with the recordings."""


@contextmanager
def lerobot_datasets() -> Any:
    """LeRobot's dataset class, offline and without progress bars of its own."""
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    import datasets

    shown = not datasets.are_progress_bars_disabled()
    datasets.disable_progress_bars()
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        yield LeRobotDataset
    finally:
        if shown:
            datasets.enable_progress_bars()


def convert(
    sources: list[Path],
    out: Path,
    *,
    recipe: ConvertRecipe | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Converted:
    """Convert recordings (files, or folders of them) into the dataset folder `out`.

    Without a `recipe`, the `[convert]` table kept in the first recording is used. The dataset is read back
    and compared with the recordings before it appears under its name.

    Raises `RecordingError` for a recording that cannot be read, `DatasetError` when recordings do not go
    together, `OutputError` when `out` exists, `VerificationError` when the dataset differs.
    """
    paths = recordings_in(sources)
    first = read_episode(paths[0])
    recipe = recipe or _recipe_kept_in(first, paths[0])
    with new_folder(out, overwrite=overwrite) as part, lerobot_datasets() as dataset_class:
        part.rmdir()  # LeRobot makes the folder and refuses one that is there
        meta = first.metadata
        dataset = dataset_class.create(
            repo_id=f"lfd/{out.name}",
            root=part,
            fps=meta.control_hz,
            robot_type=meta.robot,
            features=features_of(first, recipe),
            use_videos=False,
            video_backend="pyav",
        )
        frames = 0
        try:
            with progress("convert", len(paths)) as bar:
                for path in paths:
                    episode = read_episode(path)
                    _check_fits(episode, path, first, paths[0])
                    frames += _add(dataset, episode, recipe)
                    bar.advance(note=f"{frames} frames")
        finally:
            try:
                dataset.finalize()
            finally:  # LeRobot's destructors would write again, into a folder that is gone
                dataset.writer._finalized = dataset.meta._finalized = True
        compared = _verify(part, out.name, paths, recipe, progress, dataset_class)
        (part / MODEL).write_text(first.model_xml, encoding="utf-8")
        hashes = {str(path): sha256(path) for path in paths}
        facts = {"robot": meta.robot, "controller": meta.controller, "task": meta.task, "control_hz": meta.control_hz}
        kept = {**meta.recipe, "convert": as_table(recipe)}
        write_manifest(part, kind="dataset", recipe=kept, parents=hashes, seed=meta.seed, **facts)
    return Converted(episodes=len(paths), frames=frames, compared=compared)


def verify(
    dataset: Path, sources: list[Path], *, recipe: ConvertRecipe | None = None, progress: Progress = silent
) -> int:
    """Read a dataset and its recordings back and compare counts, numbers, tasks and episode boundaries.

    Returns how many numbers were compared. Raises `VerificationError` at the first difference.
    """
    paths = recordings_in(sources)
    recipe = recipe or _recipe_kept_in(read_episode(paths[0]), paths[0])
    if not (dataset / "meta" / "info.json").is_file():
        raise DatasetError(f"{dataset} is no LeRobot dataset: it has no meta/info.json")
    with lerobot_datasets() as dataset_class:
        return _verify(dataset, dataset.name, paths, recipe, progress, dataset_class)


def _recipe_kept_in(episode: Episode, path: Path) -> ConvertRecipe:
    table = episode.metadata.recipe.get("convert")
    if table is None:
        raise RecipeError(f"{path} was recorded by a recipe without a [convert] table; name one with --recipe")
    return build(ConvertRecipe, table, f"{path} [convert]")


def _check_fits(episode: Episode, path: Path, first: Episode, first_path: Path) -> None:
    facts: list[tuple[str, Any, Any]] = [
        (key, getattr(episode.metadata, key), getattr(first.metadata, key))
        for key in ("robot", "controller", "control_hz")
    ]
    facts.append(("components", dict(episode.labels), dict(first.labels)))
    for name, here, there in facts:
        if here != there:
            raise DatasetError(
                f"{path} has {name} {here}, {first_path} has {there}; convert them into datasets of their own"
            )
    late = np.abs(episode.times - np.arange(len(episode) + 1) / episode.metadata.control_hz)
    if late.max() > CLOCK_TOLERANCE_S:
        at = int(late.argmax())
        raise DatasetError(
            f"{path}: the observation of step {at} stands at {episode.times[at]:.4f} s, "
            f"{episode.metadata.control_hz} Hz puts it at {at / episode.metadata.control_hz:.4f} s"
        )


def _add(dataset: Any, episode: Episode, recipe: ConvertRecipe) -> int:
    columns = columns_of(episode, recipe)
    for t in range(len(episode)):
        dataset.add_frame({key: values[t] for key, values in columns.items()} | {"task": episode.metadata.instruction})
    dataset.save_episode()
    return len(episode)


def _verify(
    root: Path, name: str, paths: list[Path], recipe: ConvertRecipe, progress: Progress, dataset_class: Any
) -> int:
    dataset = dataset_class(f"lfd/{name}", root=root, video_backend="pyav")
    _compare("number of episodes", dataset.num_episodes, len(paths))
    table = dataset.hf_dataset.with_format("numpy")
    boundaries: Iterable[Mapping[str, Any]] = dataset.meta.episodes
    at = compared = 0
    with progress("verify", len(paths)) as bar:
        for index, (path, boundary) in enumerate(zip(paths, boundaries, strict=True)):
            episode = read_episode(path)
            rows = table[at : at + len(episode)]
            where = f"{path} as episode {index}"
            span = (boundary["dataset_from_index"], boundary["dataset_to_index"])
            _compare(f"{where}: rows", span, (at, at + len(episode)))
            _compare(f"{where}: task", list(boundary["tasks"]), [episode.metadata.instruction])
            _compare(f"{where}: episode_index", set(rows["episode_index"].tolist()), {index})
            expected = columns_of(episode, recipe)
            clock = {"timestamp": np.arange(len(episode), dtype=np.float32)[:, None] / dataset.fps}
            for key, values in {**expected, **clock}.items():
                read = np.asarray(rows[key]).reshape(values.shape)
                if not np.array_equal(read, values.astype(read.dtype)):
                    raise VerificationError(f"{where}: {key} differs from the recording; convert it again")
                compared += read.size
            at += len(episode)
            bar.advance(note=f"{compared} numbers equal")
    _compare("number of frames", dataset.num_frames, at)
    return compared


def _compare(what: str, read: Any, expected: Any) -> None:
    if read != expected:
        raise VerificationError(f"{what}: the dataset says {read}, the recordings say {expected}; convert them again")
