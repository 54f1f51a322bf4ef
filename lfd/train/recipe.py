"""The `[train]` table of a file in `policies/`."""

from dataclasses import dataclass
from math import cos, pi

import torch

from lfd.core.errors import RecipeError, UnknownName

SCHEDULES = ("constant", "linear", "cosine")
PRECISIONS = ("float32", "bfloat16")
LOGGERS = ("tensorboard", "wandb")


@dataclass(frozen=True, kw_only=True)
class TrainRecipe:
    """How a policy is trained."""

    steps: int
    """Gradient steps."""
    batch_size: int
    """Frames in a batch; each frame once before any comes again."""
    learning_rate: float
    """Step size of AdamW at its highest."""
    weight_decay: float
    """Weight decay of AdamW."""
    grad_clip: float
    """Largest norm of the gradient; longer ones are scaled to it."""
    seed: int
    """Seed of the initial weights and of the batches."""
    betas: tuple[float, ...] = (0.9, 0.999)
    """AdamW's decay of the means of the gradient and of its square."""
    schedule: str = "cosine"
    """How the step size falls after the warm-up: constant, linear (to 0) or cosine (half a cosine, to 0)."""
    warmup_steps: int = 0
    """Gradient steps over which the step size rises from 0."""
    ema_decay: float = 0.0
    """Decay of the moving average of the weights that is kept instead of them; 0 keeps the weights."""
    validation_fraction: float = 0.0
    """Part of the episodes that is not trained on, but judged by."""
    judge_every: int = 0
    """Gradient steps between two judgements; the best weights are kept. 0: the last weights are kept."""
    judge_episodes: int = 0
    """Rollouts of a judgement, which is then their success rate; 0 judges by the loss on the validation episodes."""
    patience: int = 0
    """Judgements without a better one after which training ends early; 0 never does."""
    checkpoint_every: int = 1000
    """Gradient steps between two checkpoints, from which an interrupted training goes on."""
    intervention_weight: int = 1
    """How many times as often steps are drawn in which a person or expert overruled the policy (IWR)."""
    precision: str = "float32"
    """Numbers of the forward pass: float32 or bfloat16 (mixed precision, on a GPU)."""
    device: str = "cpu"
    """Where to train: cpu, cuda or mps."""
    threads: int = 1
    """Threads of torch; networks this small are many times slower with more."""
    loggers: tuple[str, ...] = ()
    """Where the curves go beside metrics.jsonl: tensorboard, wandb."""

    def check(self, where: str) -> None:
        for key in ("steps", "batch_size", "learning_rate", "grad_clip", "threads", "checkpoint_every"):
            if getattr(self, key) <= 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0")
        for key in ("weight_decay", "warmup_steps", "judge_every", "judge_episodes", "patience"):
            if getattr(self, key) < 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must not be negative")
        for key in ("ema_decay", "validation_fraction"):
            if not 0 <= getattr(self, key) < 1:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be at least 0 and below 1")
        if self.intervention_weight < 1:
            raise RecipeError(f"{where} intervention_weight = {self.intervention_weight}: must be at least 1")
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise RecipeError(f"{where} betas = {list(self.betas)}: expected two numbers, at least 0 and below 1")
        for kind, known, given in (
            ("schedule", SCHEDULES, (self.schedule,)),
            ("precision", PRECISIONS, (self.precision,)),
            ("loggers", LOGGERS, self.loggers),
        ):
            for name in given:
                if name not in known:
                    raise UnknownName(f"{kind} in {where}:", name, known)
        self._check_judging(where)
        self._check_device(where)

    def _check_judging(self, where: str) -> None:
        if self.judge_every and not self.judge_episodes and not self.validation_fraction:
            raise RecipeError(
                f"{where} judge_every = {self.judge_every} has nothing to judge by: set validation_fraction = 0.1, "
                "or judge_episodes = 20 for rollouts"
            )
        if self.patience and not self.judge_every:
            raise RecipeError(f"{where} patience = {self.patience} counts judgements: set judge_every as well")

    def _check_device(self, where: str) -> None:
        available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
        if not available.get(self.device.partition(":")[0], False):
            has = ", ".join(name for name, there in available.items() if there)
            raise RecipeError(f"{where} device = {self.device!r}: this machine has {has}")

    def step_size(self, step: int) -> float:
        """Learning rate of gradient step number `step`, the first being 0."""
        if step < self.warmup_steps:
            return self.learning_rate * (step + 1) / (self.warmup_steps + 1)
        done = (step - self.warmup_steps) / max(self.steps - self.warmup_steps, 1)
        left = {"constant": 1.0, "linear": 1.0 - done, "cosine": 0.5 * (1.0 + cos(pi * done))}
        return self.learning_rate * left[self.schedule]
