"""Which frames make a batch: drawn an epoch at a time, since a draw for each batch costs more than the batch."""

from collections.abc import Mapping

import torch
from jaxtyping import Int
from torch import Tensor


class Batches:
    """Numbers of frames, `batch_size` at a time, from `indices`.

    An epoch holds every frame once, in an order of its own; with `replacement` as many frames, each drawn from all.
    A batch that an epoch does not fill goes on in the next, so that all have the same size. What comes next depends
    on the generator's state and the position in the epoch alone: `state` and `load_state` resume in the middle.
    """

    def __init__(
        self,
        indices: Int[Tensor, "M"],
        batch_size: int,
        generator: torch.Generator,
        *,
        replacement: bool = False,
        device: str | torch.device = "cpu",
    ):
        assert len(indices) > 0
        assert batch_size > 0
        self._indices, self._size, self._generator = indices, batch_size, generator
        self._replacement, self._device = replacement, device
        self._draw()

    def next_index(self) -> Int[Tensor, "B"]:
        """The frames of the next batch."""
        begin, end = self._position, self._position + self._size
        if end <= len(self._order):
            self._position = end
            return self._order[begin:end]
        parts, missing = [self._order[begin:]], end - len(self._order)
        while missing > 0:
            self._draw()
            self._position = min(missing, len(self._order))
            parts.append(self._order[: self._position])
            missing -= self._position
        return torch.cat(parts)

    def state(self) -> dict[str, Tensor]:
        """What `load_state` needs to go on from here."""
        return {"generator": self._before, "position": torch.tensor(self._position)}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where another sampler of the same indices and batch size was."""
        self._generator.set_state(state["generator"])
        self._draw()
        self._position = int(state["position"])

    def _draw(self) -> None:
        """Begin an epoch."""
        self._before = self._generator.get_state()
        count = len(self._indices)
        if self._replacement:
            chosen = torch.randint(count, (count,), generator=self._generator)
        else:
            chosen = torch.randperm(count, generator=self._generator)
        self._order = self._indices[chosen].to(self._device)
        self._position = 0
