"""A LeRobot v3 dataset as tensors in memory.

The numbers of such a dataset are few (a thousand episodes of 200 frames with 30 numbers are 24 MB), so they
are read once and sampled by indexing, instead of being looked up in files item by item. So are pictures, as bytes.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Bool, Float, Int, UInt8

from lfd.convert.dataset.dataset_files import UNREADABLE, DatasetFiles
from lfd.convert.dataset.lerobot_writer import STATS
from lfd.core.channels import ENVIRONMENT_STATE, STATE
from lfd.core.errors import DatasetError
from lfd.core.protocols import Progress, silent
from lfd.data.pictures import camera_features, load_pictures

Stats = dict[str, dict[str, torch.Tensor]]
POLICY_FEATURES = (STATE, ENVIRONMENT_STATE, "action")
INTERVENTION = "intervention"


@dataclass(frozen=True)
class Frames:
    """All frames of a dataset, episodes one after the other."""

    columns: Mapping[str, Float[torch.Tensor, "N _"]]
    """Feature to its rows, float32: the observation's and the action."""
    episode_index: Int[torch.Tensor, "N"]
    names: Mapping[str, tuple[str, ...]]
    """Feature to the names of its components."""
    stats: Stats
    """Feature to mean, std, min, max and so on, as LeRobot computed them."""
    fps: float
    units: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Feature to the units of its components; empty texts where the dataset does not say."""
    images: Mapping[str, UInt8[torch.Tensor, "N 3 H W"]] = field(default_factory=dict)
    """Feature to its pictures, RGB; LeRobot's are these divided by 255."""
    intervention: Bool[torch.Tensor, "N"] | None = None
    """Whether a person or expert overruled the policy, where the dataset has it."""

    def __len__(self) -> int:
        return len(self.episode_index)

    @property
    def episodes(self) -> tuple[Int[torch.Tensor, "E"], Int[torch.Tensor, "E"]]:
        """The first frame of each episode, and the one after its last."""
        lengths = torch.unique_consecutive(self.episode_index, return_counts=True)[1]
        ends = torch.cumsum(lengths, 0)
        return ends - lengths, ends


def load_frames(root: Path, *, images: bool = True, progress: Progress = silent) -> Frames:
    """Read the dataset folder `root`; without `images` its pictures stay on disk.

    Raises `DatasetError` for a folder that is no LeRobot v3 dataset, that lacks a feature or a statistic, that holds a
    number that is not finite, or pictures that cannot be decoded or do not fit into memory.
    """
    files = DatasetFiles(root)
    for feature in (STATE, "action"):
        if feature not in files.features:
            raise DatasetError(f"{root} has no feature {feature!r}; it has {', '.join(sorted(files.features))}")
    features = [name for name in POLICY_FEATURES if name in files.features]
    cameras = camera_features(files) if images else ()
    stats = _stats(root, (*features, *cameras))
    flags = [INTERVENTION] if INTERVENTION in files.features else []
    table = _table(files, [*features, *flags, "episode_index"])
    episodes = table["episode_index"].to_numpy()
    if (np.diff(episodes) < 0).any():
        raise DatasetError(f"{root}/data does not have its episodes one after the other; convert the recordings again")
    return Frames(
        columns={f: _rows(table[f], files.features[f]["shape"], episodes, f, root) for f in features},
        episode_index=torch.from_numpy(episodes.copy()),
        names={f: files.names(f) for f in features},
        stats=stats,
        fps=float(files.fps),
        units={f: files.units(f) for f in features},
        images=load_pictures(files, cameras, progress) if cameras else {},
        intervention=torch.from_numpy(table[INTERVENTION].to_numpy().astype(bool)) if flags else None,
    )


def _stats(root: Path, features: tuple[str, ...]) -> Stats:
    path = root / STATS
    if not path.is_file():
        raise DatasetError(f"{root} is no LeRobot dataset: it has no {STATS}; `lfd convert` makes one of recordings")
    try:
        stats = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DatasetError(f"{path} is no JSON ({error}); convert the recordings again") from error
    for feature in features:
        if not {"mean", "std", "min", "max"} <= set(stats.get(feature, {})):
            raise DatasetError(f"{root}/{STATS} lacks the statistics of {feature}; convert the recordings again")
    return {f: {k: torch.tensor(v, dtype=torch.float32) for k, v in stats[f].items()} for f in features}


def _table(files: DatasetFiles, names: list[str]) -> pa.Table:
    root = files.root
    paths = sorted((root / "data").rglob("*.parquet"))
    if not paths:
        raise DatasetError(f"{root} has no data/*.parquet; convert the recordings again")
    try:
        table = pa.concat_tables(pq.read_table(path, columns=names) for path in paths)
    except UNREADABLE as error:
        raise DatasetError(f"{root}/data cannot be read ({error}); convert the recordings again") from error
    if len(table) != files.info["total_frames"]:
        raise DatasetError(f"{root}/data has {len(table)} frames, meta/info.json says {files.info['total_frames']}")
    return table


def _rows(
    column: pa.ChunkedArray, shape: Sequence[int], episodes: np.ndarray, feature: str, root: Path
) -> torch.Tensor:
    if len(shape) != 1:
        raise DatasetError(f"{root}: {feature} has the shape {tuple(shape)}, expected one vector for each frame")
    (size,) = shape
    array = column.combine_chunks()  # LeRobot keeps vectors of one number as numbers
    flat = (array if size == 1 and pa.types.is_floating(array.type) else array.flatten()).to_numpy(zero_copy_only=False)
    if flat.size != len(column) * size:
        raise DatasetError(f"{root}: {feature} has {flat.size} numbers, {len(column)} rows of {size} were expected")
    values = flat.reshape(len(column), size).astype(np.float32)
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise DatasetError(f"{root}: {feature} is not finite in row {row} (episode {episodes[row]}); leave it out")
    return torch.from_numpy(values)
