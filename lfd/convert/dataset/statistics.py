"""Statistics of an episode and of a dataset, as LeRobot keeps them: min, max, mean, std, count and five quantiles.

An episode's quantiles are exact. A dataset's are the means of its episodes' quantiles, weighted by their lengths:
LeRobot aggregates them so, and a dataset can grow without being read again.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Shaped, UInt8

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Stats = Mapping[str, np.ndarray]
SAMPLED_PICTURES = 100
"""An episode's picture statistics come from so many of its pictures, spread evenly."""
SAMPLED_SIDE = 150
"""Pictures larger than twice this are thinned to about this many pixels a side."""


def column_stats(columns: Mapping[str, Shaped[np.ndarray, "T _"]]) -> dict[str, Stats]:
    """Statistics of the columns of an episode, each component by itself."""
    joined = np.concatenate([rows.astype(np.float64) for rows in columns.values()], axis=1)
    found = _stats(joined, len(joined))
    ends = np.cumsum([rows.shape[1] for rows in columns.values()])
    return {
        name: {key: value if key == "count" else value[end - rows.shape[1] : end] for key, value in found.items()}
        for (name, rows), end in zip(columns.items(), ends, strict=True)
    }


def picture_stats(pictures: Sequence[UInt8[np.ndarray, "H W 3"]]) -> Stats:
    """Statistics of each colour in [0, 1], shape (3, 1, 1)."""
    height, width, _ = pictures[0].shape
    step = max(1, max(height, width) // SAMPLED_SIDE) if max(height, width) >= 2 * SAMPLED_SIDE else 1
    pixels = np.concatenate([picture[::step, ::step].reshape(-1, 3) for picture in pictures]) / 255
    return {k: v if k == "count" else v.reshape(3, 1, 1) for k, v in _stats(pixels, len(pictures)).items()}


def sampled_rows(count: int) -> list[int]:
    """Rows of the pictures that the statistics are computed from."""
    return np.linspace(0, count - 1, min(count, SAMPLED_PICTURES)).round().astype(int).tolist()


def _stats(rows: Shaped[np.ndarray, "N D"], count: int) -> dict[str, np.ndarray]:
    ordered = np.sort(rows, axis=0)
    found = {"min": ordered[0], "max": ordered[-1], "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    for name, quantile in QUANTILES.items():  # linear between the two neighbours, as numpy.quantile
        place = quantile * (len(ordered) - 1)
        below, share = int(place), place % 1
        above = min(below + 1, len(ordered) - 1)
        found[name] = ordered[below] + share * (ordered[above] - ordered[below])
    return found | {"count": np.array([count])}


def aggregate(parts: Sequence[Mapping[str, Stats]]) -> dict[str, Stats]:
    """Statistics of all parts together; mean and variance by the parallel formula of Chan et al. 1979."""
    return {name: _together([part[name] for part in parts]) for name in parts[0]}


def _together(parts: Sequence[Stats]) -> Stats:
    def stacked(key: str) -> np.ndarray:
        return np.stack([np.asarray(part[key], dtype=np.float64) for part in parts])

    counts = stacked("count")
    weights = counts.reshape(-1, *[1] * (stacked("mean").ndim - 1)) / counts.sum()
    mean = (weights * stacked("mean")).sum(axis=0)
    variance = (weights * (stacked("std") ** 2 + (stacked("mean") - mean) ** 2)).sum(axis=0)
    found = {"min": stacked("min").min(axis=0), "max": stacked("max").max(axis=0), "mean": mean}
    found |= {"std": np.sqrt(variance), "count": counts.sum(axis=0).astype(int)}
    return found | {name: (weights * stacked(name)).sum(axis=0) for name in QUANTILES}
