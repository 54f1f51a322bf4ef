"""Windows of frames around a frame: the histories and chunks that LeRobot gives with `delta_timestamps`.

A window that begins before its episode repeats the first frame, one that runs past its end the last, and `is_pad` says
where. Each episode is laid out once with its ends repeated, so that every window of successive frames is one run of
memory, and a batch is one copy of a run for each of its rows.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from lfd.core.errors import DatasetError

Deltas = Mapping[str, Sequence[int] | None]
"""Feature to its window, frames relative to the current one; None for the current frame without an axis of time."""


def deltas_of(config: Any, features: Iterable[str]) -> dict[str, list[int] | None]:
    """The windows that a LeRobot policy configuration asks for: one for all observations, one for the action."""
    observation, action = config.observation_delta_indices, config.action_delta_indices
    return {
        name: action if name == "action" else observation if name.startswith("observation.") else None
        for name in features
    }


class Windows:
    """Batches of `columns` (feature to N rows, of any shape) by frame number, with the windows that `deltas` ask for.

    Batches are LeRobot's to the bit, names included: a feature (B, D), or (B, n, D) and `FEATURE_is_pad` (B, n).
    """

    def __init__(
        self,
        columns: Mapping[str, Tensor],
        episode_index: Int[Tensor, "N"],
        deltas: Deltas,
        device: str | torch.device = "cpu",
    ):
        assert set(deltas) == set(columns), f"windows of {sorted(deltas)} for {sorted(columns)}"
        first, last = episode_ends(episode_index)
        self._first, self._last = first.to(device), last.to(device)
        self._device = torch.device(device)
        wanted = {tuple(window) for window in deltas.values() if window is not None}
        runs = {window for window in wanted if _is_run(window)}
        before, behind = -min((w[0] for w in runs), default=0), max((w[-1] for w in runs), default=0)
        layout = _Layout(first, last, max(before, 0), max(behind, 0))
        self._places = layout.places.to(device)
        self._pads = {window: layout.views(layout.pad, window).to(device) for window in runs}
        self._rows: dict[str, Tensor] = {}
        self._runs: dict[str, tuple[Tensor, tuple[int, ...]]] = {}
        self._windows = {name: None if window is None else tuple(window) for name, window in deltas.items()}
        self._offsets = {window: torch.tensor(window, device=device) for window in wanted}
        for name, rows in columns.items():
            assert len(rows) == len(episode_index), f"{name} has {len(rows)} rows of {len(episode_index)} frames"
            window = self._windows[name]
            if window in runs and rows.ndim <= 2:  # of pictures, which are long runs already, it would be a copy
                spread = rows.to(device)[layout.source.to(device)]
                self._runs[name] = layout.views(spread, window), (-1, len(window), *rows.shape[1:])
            else:
                self._rows[name] = rows.to(device)

    def __len__(self) -> int:
        """Number of frames N."""
        return len(self._first)

    def batch(self, index: Int[Tensor, "B"]) -> dict[str, Tensor]:
        """The frames `index` and what is around them."""
        index = index.to(self._device)
        places = self._places.index_select(0, index) if self._pads else index
        pads = {window: view.index_select(0, places) for window, view in self._pads.items()}
        batch = {}
        for name, window in self._windows.items():
            if window is None:
                batch[name] = self._rows[name].index_select(0, index)
                continue
            if name in self._runs:
                view, shape = self._runs[name]
                batch[name] = view.index_select(0, places).view(shape)
            else:
                batch[name], pads[window] = self._gather(self._rows[name], index, window)
            batch[f"{name}_is_pad"] = pads[window]
        return batch

    def sampleable(self, drop_last: int) -> Int[Tensor, "M"]:
        """Frames with at least `drop_last` frames behind them in their episode, LeRobot's `drop_n_last_frames`.

        Raises `DatasetError` when no episode is long enough.
        """
        found = torch.nonzero(self._last - torch.arange(len(self), device=self._device) >= drop_last)[:, 0].cpu()
        if not len(found):
            longest = int((self._last - self._first).max()) + 1
            raise DatasetError(
                f"the longest episode has {longest} frames, the policy leaves out the last {drop_last} of each; "
                "record longer episodes, or choose a shorter horizon in the recipe's [policy]"
            )
        return found

    def _gather(self, rows: Tensor, index: Tensor, window: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """Windows that are no runs, row by row."""
        first, last = self._first.index_select(0, index)[:, None], self._last.index_select(0, index)[:, None]
        asked = index[:, None] + self._offsets[window]
        inside = torch.minimum(torch.maximum(asked, first), last)
        return rows.index_select(0, inside.flatten()).view(*inside.shape, *rows.shape[1:]), asked != inside


class _Layout:
    """Episodes one after the other, the first frame of each repeated `before` times and the last `behind` times."""

    def __init__(self, first: Int[Tensor, "N"], last: Int[Tensor, "N"], before: int, behind: int):
        frames = torch.arange(len(first))
        number = torch.cumsum(frames == first, 0) - 1
        more = before + behind
        self.before, self.places = before, frames + more * number
        """Frame to where its window would begin if it reached back by `before`."""
        starts = frames[frames == first]
        lengths = last[starts] - starts + 1 + more
        asked = torch.arange(len(first) + more * len(starts)) - before
        asked -= torch.repeat_interleave(more * torch.arange(len(starts)), lengths)
        low, high = (torch.repeat_interleave(ends[starts], lengths) for ends in (first, last))
        self.source: Int[Tensor, "M"] = torch.minimum(torch.maximum(asked, low), high)
        """Place to the frame that is there."""
        self.pad: Bool[Tensor, "M 1"] = (asked != self.source)[:, None]
        """Place to whether it is a repetition."""

    def views(self, spread: Tensor, window: Sequence[int]) -> Tensor:
        """The window of every place as a row, without a copy: row `places[t]` is that of frame t."""
        size, n = spread[0].numel(), len(window)
        begin = window[0] + self.before
        return spread.as_strided((len(spread) - begin - n + 1, n * size), (size, 1), begin * size)


def episode_ends(episode_index: Int[Tensor, "N"]) -> tuple[Int[Tensor, "N"], Int[Tensor, "N"]]:
    """The first and the last frame of every frame's episode."""
    _, lengths = torch.unique_consecutive(episode_index.cpu(), return_counts=True)
    end = torch.cumsum(lengths, 0)
    return torch.repeat_interleave(end - lengths, lengths), torch.repeat_interleave(end - 1, lengths)


def _is_run(window: Sequence[int]) -> bool:
    return all(later == sooner + 1 for sooner, later in pairwise(window))
