"""A dataset as a policy is trained on it: normalised once, cut into windows, split by episodes."""

from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from lfd.core.errors import DatasetError, PolicyError
from lfd.data.frames import Frames
from lfd.data.splits import split_episodes
from lfd.data.windows import Windows, deltas_of
from lfd.train.recipe import TrainRecipe


class TrainingData:
    """Batches for a policy with configuration `config`; `before` is its preprocessor.

    Numbers are normalised here, all rows at once: the preprocessor is the same function for every row. Pictures stay
    bytes until they are in a batch.

    Raises `DatasetError` when too few episodes are there to split, `PolicyError` when normalising gives no numbers.
    """

    train: Int[Tensor, "T"]
    """Frames to train on, those with interventions repeated as often as the recipe weighs them."""
    validation: Int[Tensor, "V"]
    """Frames to judge by; of other episodes."""

    def __init__(self, frames: Frames, config: Any, before: Any, recipe: TrainRecipe):
        self._episodes, self._images, self._before = frames.episode_index, list(frames.images), before
        rows = {**normalised(frames, before, recipe.device), **frames.images}
        self._windows = Windows(rows, frames.episode_index, deltas_of(config, rows), recipe.device)
        usable = torch.zeros(len(frames), dtype=torch.bool)
        usable[self._windows.sampleable(getattr(config, "drop_n_last_frames", 0))] = True
        train, self.validation = (
            part[usable[part]] for part in split_episodes(frames.episode_index, recipe.validation_fraction, recipe.seed)
        )
        if not len(train) or (recipe.validation_fraction and not len(self.validation)):
            raise DatasetError("after the split no episode is long enough; record more, or validate on fewer")
        self.train = train
        if recipe.intervention_weight > 1:
            if frames.intervention is None:
                raise DatasetError(
                    f"intervention_weight = {recipe.intervention_weight} needs the feature 'intervention', which the "
                    "dataset lacks; convert recordings of lfd, or leave it at 1"
                )
            again = train[frames.intervention[train]]
            self.train = torch.cat([train, again.repeat(recipe.intervention_weight - 1)])

    def batch(self, index: Int[Tensor, "B"]) -> dict[str, Tensor]:
        """The frames `index`, as the policy's `forward` takes them."""
        batch = self._windows.batch(index)
        if self._images:
            pictures = {name: batch[name].float() / 255 for name in self._images}
            batch |= {name: self._before(pictures)[name] for name in self._images}
        return batch

    def episodes(self, index: Int[Tensor, "B"]) -> list[int]:
        """Numbers of the episodes that frames belong to."""
        return sorted(set(self._episodes[index.cpu()].tolist()))


def normalised(frames: Frames, before: Any, device: str) -> dict[str, Tensor]:
    """All low-dimensional rows as the policy wants them.

    Raises `PolicyError` when one is not finite.
    """
    done = before(dict(frames.columns))
    rows = {key: done[key].to(device) for key in frames.columns}
    for key, values in rows.items():
        if not torch.isfinite(values).all():
            raise PolicyError(f"{key} is not finite after normalising; look at its statistics in meta/stats.json")
    return rows
