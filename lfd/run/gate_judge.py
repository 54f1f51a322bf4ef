"""A small network that answers yes or no about a state, or about an action in it: what learned gates rest on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float

from lfd.core.channels import observed
from lfd.core.errors import TrainingError
from lfd.core.protocols import Observation

LEAST_SPREAD = 1e-6
"""Standard deviation below which an input counts as constant, and stays unscaled."""


@dataclass(frozen=True, kw_only=True)
class JudgeTraining:
    """How a judge is trained."""

    steps: int
    """Gradient steps."""
    batch_size: int
    """Rows in a batch, drawn with replacement."""
    learning_rate: float
    """Step size of Adam."""
    hidden: tuple[int, ...]
    """Units of the hidden layers."""
    seed: int
    """Seed of the initial weights and of the batches."""


class Judge(torch.nn.Module):
    """A probability in (0, 1) for each row of D numbers, which it scales by the mean and spread of its first rows."""

    mean: torch.Tensor
    spread: torch.Tensor

    def __init__(self, rows: Float[np.ndarray, "N D"], hidden: Sequence[int]):
        super().__init__()
        spread = rows.std(axis=0)
        self.register_buffer("mean", torch.tensor(rows.mean(axis=0), dtype=torch.float32))
        self.register_buffer("spread", torch.tensor(np.where(spread > LEAST_SPREAD, spread, 1.0), dtype=torch.float32))
        sizes = [rows.shape[1], *hidden]
        layers: list[torch.nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            layers += [torch.nn.Linear(inputs, outputs), torch.nn.SiLU()]
        self.layers = torch.nn.Sequential(*layers, torch.nn.Linear(sizes[-1], 1))

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """The log-odds of yes, one a row."""
        return self.layers((rows - self.mean) / self.spread).squeeze(-1)

    def of(self, rows: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N"]:
        """The probability of yes, one a row."""
        with torch.no_grad():
            return torch.sigmoid(self(torch.as_tensor(rows, dtype=torch.float32))).double().numpy()


def fit_judge(
    rows: Float[np.ndarray, "N D"], how: JudgeTraining, targets: Callable[[Judge, torch.Tensor], torch.Tensor]
) -> Judge:
    """Descend the cross-entropy to `targets(judge, index)`, probabilities in [0, 1] for the rows of an index.

    The cross-entropy is smallest where the answer is the targets' conditional mean, as with squared error; but it does
    not flatten where the answer is wrong and certain. Targets may rest on the judge's own answers; they carry no
    gradient. Raises `TrainingError` when the loss is not finite.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(how.seed)
        judge = Judge(rows, how.hidden)
    generator = torch.Generator().manual_seed(how.seed)
    optimizer = torch.optim.Adam(judge.parameters(), lr=how.learning_rate)
    inputs = torch.as_tensor(rows, dtype=torch.float32)
    for step in range(how.steps):
        index = torch.randint(len(inputs), (how.batch_size,), generator=generator)
        with torch.no_grad():
            wanted = targets(judge, index)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(judge(inputs[index]), wanted)
        if not torch.isfinite(loss):
            raise TrainingError(f"a gate's loss is {float(loss)} at step {step}; try a smaller learning_rate")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return judge


def features(observation: Observation, channels: Sequence[str]) -> Float[np.ndarray, "Do"]:
    """The channels that a judge sees, one after the other."""
    return np.concatenate([observed(observation, name) for name in channels])
