"""The train stage: behaviour cloning, supervised learning on the demonstrated states (chapter 10.2)."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lfd.core.artifact import new_folder, read_manifest, sha256, write_manifest
from lfd.core.errors import DatasetError, PolicyError, RecipeError, TrainingError
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import as_table
from lfd.data.frames import Frames, load_frames
from lfd.policies.registry import make_policy

METRICS = "metrics.jsonl"
REPORTS = 100  # lines in the metrics of one training


@dataclass(frozen=True, kw_only=True)
class TrainRecipe:
    """The `[train]` table of a file in `policies/`."""

    steps: int
    """Gradient steps."""
    batch_size: int
    """Frames in a batch, drawn with replacement."""
    learning_rate: float
    """Step size of AdamW at the start; it falls to 0 along a half cosine."""
    weight_decay: float
    """Weight decay of AdamW."""
    grad_clip: float
    """Largest norm of the gradient; longer ones are scaled to it."""
    seed: int
    """Seed of the initial weights and of the batches."""
    device: str = "cpu"
    """Where to train: cpu, cuda or mps."""
    threads: int = 1
    """Threads of torch; networks this small are many times slower with more."""

    def check(self, where: str) -> None:
        for key in ("steps", "batch_size", "learning_rate", "grad_clip", "threads"):
            if getattr(self, key) <= 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0")
        available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
        if not available.get(self.device.partition(":")[0], False):
            has = ", ".join(name for name, there in available.items() if there)
            raise RecipeError(f"{where} device = {self.device!r}: this machine has {has}")


@dataclass(frozen=True)
class Trained:
    """What a run of the train stage did."""

    steps: int
    loss: float
    """Mean training loss over the last hundredth of the steps."""
    frames: int
    parameters: int


def train(
    policy_table: dict[str, Any],
    recipe: TrainRecipe,
    dataset: Path,
    out: Path,
    *,
    tables: Mapping[str, Any],
    overwrite: bool = False,
    progress: Progress = silent,
) -> Trained:
    """Train a policy on `dataset` and save it into the folder `out`, complete, as LeRobot does.

    Raises `DatasetError` for a dataset that cannot be used, `TrainingError` when the loss is not finite,
    `OutputError` when `out` exists.
    """
    frames = load_frames(dataset)
    about = read_manifest(dataset)
    if about is None or about.get("kind") != "dataset":
        raise DatasetError(f"{dataset} has no manifest.json of a dataset; make it with `lfd convert`")
    threads = torch.get_num_threads()
    torch.set_num_threads(recipe.threads)
    try:
        with new_folder(out, overwrite=overwrite) as part:
            torch.manual_seed(recipe.seed)
            policy, before, after = make_policy(policy_table, frames, recipe.device, "[policy]")
            curve = fit(policy, normalised(frames, before, recipe.device), recipe, progress)
            policy.save_pretrained(part)
            before.save_pretrained(part)
            after.save_pretrained(part)
            (part / METRICS).write_text("".join(json.dumps(row) + "\n" for row in curve), encoding="utf-8")
            plot_curve(curve, part / "loss.png")
            used = {**tables, "policy": policy_table, "train": as_table(recipe)}
            facts = {key: about[key] for key in ("robot", "controller", "task", "control_hz")}
            names = {key: list(value) for key, value in frames.names.items() if key != "action"}
            write_manifest(
                part,
                kind="policy",
                recipe=used,
                parents={str(dataset): sha256(dataset)},
                seed=recipe.seed,
                policy=policy_table["type"],
                features=names,
                **facts,
            )
    finally:
        torch.set_num_threads(threads)
    return Trained(recipe.steps, curve[-1]["loss"], len(frames), sum(p.numel() for p in policy.parameters()))


def normalised(frames: Frames, before: Any, device: str) -> dict[str, torch.Tensor]:
    """All frames as the policy wants them, once: the preprocessor is the same function for every row."""
    done = before(dict(frames.columns))
    batch = {key: done[key].to(device) for key in frames.columns}
    for key, rows in batch.items():
        if not torch.isfinite(rows).all():
            raise PolicyError(f"{key} is not finite after normalising; look at its statistics in meta/stats.json")
    return batch


def fit(policy: Any, rows: Mapping[str, torch.Tensor], recipe: TrainRecipe, progress: Progress) -> list[dict[str, Any]]:
    """Descend the loss over `rows`; returns step, mean loss and learning rate at `REPORTS` points.

    Raises `TrainingError` when the loss is not finite.
    """
    optimizer = torch.optim.AdamW(policy.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, recipe.steps)
    generator = torch.Generator().manual_seed(recipe.seed)
    count = len(next(iter(rows.values())))
    every = math.ceil(recipe.steps / REPORTS)
    curve: list[dict[str, Any]] = []
    recent: list[torch.Tensor] = []
    policy.train()
    with progress("train", recipe.steps) as bar:
        for step in range(1, recipe.steps + 1):
            index = torch.randint(count, (recipe.batch_size,), generator=generator)
            loss, _ = policy.forward({key: values[index] for key, values in rows.items()})
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), recipe.grad_clip)
            optimizer.step()
            schedule.step()
            recent.append(loss.detach())
            if step % every == 0 or step == recipe.steps:
                mean = float(torch.stack(recent).mean())
                if not math.isfinite(mean):
                    raise TrainingError(f"the loss is {mean} at step {step}; try a smaller train.learning_rate")
                curve.append({"step": step, "loss": mean, "learning_rate": schedule.get_last_lr()[0]})
                bar.advance(len(recent), note=f"loss {mean:.4f}")
                recent.clear()
    policy.eval()
    return curve


def plot_curve(curve: list[dict[str, Any]], path: Path) -> None:
    """The training loss against gradient steps, as a picture."""
    from matplotlib.figure import Figure

    axes = (figure := Figure(figsize=(6, 3.5), layout="constrained")).subplots()
    axes.semilogy([row["step"] for row in curve], [row["loss"] for row in curve])
    axes.set(xlabel="gradient step", ylabel="loss", title="training loss")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
