"""A low-dimensional LeRobot v3 dataset as tensors in memory.

The numbers of such a dataset are few (a thousand episodes of 200 frames with 30 numbers are 24 MB), so they
are read once and sampled by indexing, instead of being looked up in files item by item.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float, Int

from lfd.core.channels import ENVIRONMENT_STATE, STATE
from lfd.core.errors import DatasetError

Stats = dict[str, dict[str, torch.Tensor]]
POLICY_FEATURES = (STATE, ENVIRONMENT_STATE, "action")


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

    def __len__(self) -> int:
        return len(self.episode_index)


def load_frames(root: Path) -> Frames:
    """Read the low-dimensional features of the dataset folder `root`.

    Raises `DatasetError` for a folder that is no LeRobot v3 dataset, that lacks a feature or a statistic, or
    that holds a number that is not finite.
    """
    info = _read_json(root, "meta/info.json")
    version = str(info.get("codebase_version"))
    if not version.startswith("v3"):
        raise DatasetError(f"{root} is a LeRobot dataset of version {version}, expected v3.0")
    for feature in (STATE, "action"):
        if feature not in info["features"]:
            raise DatasetError(f"{root} has no feature {feature!r}; it has {', '.join(sorted(info['features']))}")
    features = [f for f in POLICY_FEATURES if f in info["features"]]
    files = sorted((root / "data").rglob("*.parquet"))
    if not files:
        raise DatasetError(f"{root} has no data/*.parquet; convert the recordings again")
    try:
        table = pa.concat_tables(pq.read_table(file, columns=[*features, "episode_index"]) for file in files)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"{root}/data cannot be read ({error}); convert the recordings again") from error
    if len(table) != info["total_frames"]:
        raise DatasetError(f"{root}/data has {len(table)} frames, meta/info.json says {info['total_frames']}")
    episodes = table["episode_index"].to_numpy()
    columns = {f: _rows(table[f], info["features"][f]["shape"][0], episodes, f, root) for f in features}
    stats = _read_json(root, "meta/stats.json")
    for feature in features:
        if not {"mean", "std", "min", "max"} <= set(stats.get(feature, {})):
            raise DatasetError(
                f"{root}/meta/stats.json lacks the statistics of {feature}; convert the recordings again"
            )
    return Frames(
        columns=columns,
        episode_index=torch.from_numpy(episodes.copy()),
        names={f: _component_names(info["features"][f]) for f in features},
        stats={f: {k: torch.tensor(v, dtype=torch.float32) for k, v in stats[f].items()} for f in features},
        fps=float(info["fps"]),
    )


def _component_names(feature: dict[str, Any]) -> tuple[str, ...]:
    """Names of a feature's components; LeRobot allows a list, a dict of lists, or none."""
    names = feature.get("names")
    if isinstance(names, dict):
        names = [name for group in names.values() for name in group]
    return tuple(names) if names else tuple(str(i) for i in range(feature["shape"][0]))


def _read_json(root: Path, name: str) -> dict[str, Any]:
    path = root / name
    if not path.is_file():
        raise DatasetError(f"{root} is no LeRobot dataset: it has no {name}; `lfd convert` makes one of recordings")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DatasetError(f"{path} is no JSON ({error}); convert the recordings again") from error


def _rows(column: pa.ChunkedArray, size: int, episodes: np.ndarray, feature: str, root: Path) -> torch.Tensor:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    if flat.size != len(column) * size:
        raise DatasetError(f"{root}: {feature} has {flat.size} numbers, {len(column)} rows of {size} were expected")
    values = flat.reshape(len(column), size).astype(np.float32)
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise DatasetError(f"{root}: {feature} is not finite in row {row} (episode {episodes[row]}); leave it out")
    return torch.from_numpy(values)
