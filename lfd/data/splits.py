"""Training and validation frames, apart by whole episodes: neighbouring frames are nearly copies of one another."""

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from lfd.core.errors import DatasetError


def split_episodes(
    episode_index: Int[Tensor, "N"], fraction: float, seed: int
) -> tuple[Int[Tensor, "T"], Int[Tensor, "V"]]:
    """Frames to train on and frames to validate on: `fraction` of the episodes, at least one, drawn by `seed`.

    Both are in order. With a fraction of 0 nothing is held out. Raises `DatasetError` when no episode would be left to
    train on.
    """
    assert 0 <= fraction < 1, fraction
    frames = torch.arange(len(episode_index))
    if fraction == 0:
        return frames, frames[:0]
    episodes = episode_index.unique().numpy()
    held = max(1, round(fraction * len(episodes)))
    if held >= len(episodes):
        raise DatasetError(
            f"{len(episodes)} episodes cannot be split: {held} would be held out for validation and none be left to "
            "train on; record more, or hold nothing out (a validation fraction of 0)"
        )
    chosen = np.random.default_rng(seed).choice(episodes, held, replace=False)
    validation = torch.isin(episode_index, torch.from_numpy(chosen))
    return frames[~validation], frames[validation]
