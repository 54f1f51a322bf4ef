"""Gradient descent on a policy's loss, one step after the other, with a state that it can be gone on from.

theta <- theta - eta AdamW(g),   g = grad_theta mean_{x in batch} L(pi_theta(x), pi*(x)),   |g|_2 <= grad_clip
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from lfd.core.errors import TrainingError
from lfd.data.batches import Batches
from lfd.train.flat_parameters import FlatParameters
from lfd.train.processes import Processes
from lfd.train.recipe import TrainRecipe

ALONE = Processes()


class Descent:
    """A policy on its way down. What comes next depends on `state` alone, bit for bit on a CPU.

    `batch` gives the frames of an index as `policy.forward` takes them, `train` are the frames to draw from, and
    `episodes` says for an error which episodes frames belong to.
    """

    def __init__(
        self,
        policy: Any,
        batch: Callable[[Tensor], dict[str, Tensor]],
        train: Int[Tensor, "T"],
        recipe: TrainRecipe,
        *,
        episodes: Callable[[Tensor], list[int]] = lambda index: index.tolist(),
        processes: Processes = ALONE,
    ):
        beta_1, beta_2 = recipe.betas
        self.policy, self.recipe, self.step, self.processes = policy, recipe, 0, processes
        self._batch, self._episodes = batch, episodes
        self.flat = FlatParameters(policy, betas=(beta_1, beta_2), weight_decay=recipe.weight_decay)
        generator = torch.Generator().manual_seed(recipe.seed)
        self._sampler = Batches(train, recipe.batch_size, generator, device=recipe.device)
        self._average = [values.clone() for values in self.flat.values] if recipe.ema_decay else []
        self._mixed = recipe.precision != "float32"

    def advance(self, until: int) -> float:
        """Take steps up to number `until`; returns their mean loss.

        Raises `TrainingError`, which names the batch's episodes, when a loss or a gradient is not finite.
        """
        recipe, flat, processes = self.recipe, self.flat, self.processes
        losses, norms, indices = [], [], []
        self.policy.train()
        for step in range(self.step, until):
            index = processes.share(self._sampler.next_index())
            with self._precision():
                loss, _ = self.policy.forward(self._batch(index))
            flat.zero()
            loss.backward()
            processes.average(flat.gradients)
            norms.append(flat.step(recipe.step_size(step), recipe.grad_clip))
            if self._average:
                decay = min(recipe.ema_decay, (1 + step) / (10 + step))  # the first weights are forgotten fast
                for average, values in zip(self._average, flat.values, strict=True):
                    average.lerp_(values, 1 - decay)
            losses.append(loss.detach())
            indices.append(index)
        self._check(torch.stack(losses), torch.stack(norms), indices)
        self.step = until
        mean = torch.stack(losses).mean()
        processes.average([mean])
        return float(mean)

    def loss(self, index: Int[Tensor, "V"], size: int = 1024) -> float:
        """The mean loss over the frames `index`, without a step; what it draws is the same each time."""
        self.policy.eval()
        total = 0.0
        with torch.no_grad(), torch.random.fork_rng(devices=[]), self._precision():
            torch.manual_seed(self.recipe.seed)
            for part in index.split(size):
                total += float(self.policy.forward(self._batch(part))[0]) * len(part)
        return total / len(index)

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Within it the policy has the averaged weights, where an average is kept."""
        own = [values.clone() for values in self.flat.values]
        for values, average in zip(self.flat.values, self._average, strict=False):
            values.copy_(average)
        try:
            yield
        finally:
            for values, mine in zip(self.flat.values, own, strict=True):
                values.copy_(mine)

    def state(self) -> dict[str, Tensor]:
        """All that decides what comes next."""
        kept = {f"flat.{key}": value for key, value in self.flat.state().items()}
        kept |= {f"average.{i}": average.clone() for i, average in enumerate(self._average)}
        kept |= {f"sampler.{key}": value.clone() for key, value in self._sampler.state().items()}
        kept["random.cpu"], kept["step"] = torch.get_rng_state(), torch.tensor(self.step)
        if self.recipe.device.startswith("cuda"):
            kept["random.cuda"] = torch.cuda.get_rng_state()
        return kept

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where `state` was taken, with the same data and recipe."""
        parts: dict[str, dict[str, Tensor]] = {}
        for key, value in state.items():
            part, _, name = key.partition(".")
            parts.setdefault(part, {})[name] = value
        self.flat.load_state(parts["flat"])
        for i, average in enumerate(self._average):
            average.copy_(parts["average"][str(i)])
        self._sampler.load_state(parts["sampler"])
        torch.set_rng_state(parts["random"]["cpu"])
        if "cuda" in parts["random"]:
            torch.cuda.set_rng_state(parts["random"]["cuda"])
        self.step = int(state["step"])

    def _precision(self) -> Any:
        if not self._mixed:
            return nullcontext()
        return torch.autocast(self.recipe.device.partition(":")[0], dtype=torch.bfloat16)

    def _check(self, losses: Tensor, norms: Tensor, indices: list[Tensor]) -> None:
        bad = ~(torch.isfinite(losses) & torch.isfinite(norms))
        if not bad.any():
            return
        at = int(torch.nonzero(bad)[0])
        what, value = ("loss", losses[at]) if not torch.isfinite(losses[at]) else ("gradient's norm", norms[at])
        raise TrainingError(
            f"the {what} is {float(value)} at step {self.step + at + 1}, in a batch of episodes "
            f"{_listed(self._episodes(indices[at]))}; try a smaller train.learning_rate, or look at these episodes"
        )


def _listed(numbers: list[int], most: int = 12) -> str:
    shown = ", ".join(map(str, numbers[:most]))
    return shown if len(numbers) <= most else f"{shown} and {len(numbers) - most} others"
