"""What a training reports: one line of JSON a row, a picture, and the loggers that were asked for."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lfd.core.errors import InputError

METRICS = "metrics.jsonl"
Row = Mapping[str, Any]


def write_metrics(folder: Path, curve: Sequence[Row]) -> None:
    """The curve as `metrics.jsonl` and `loss.png` in a folder."""
    (folder / METRICS).write_text("".join(json.dumps(row) + "\n" for row in curve), encoding="utf-8")
    _plot(curve, folder / "loss.png")


def _plot(curve: Sequence[Row], path: Path) -> None:
    """The training loss against gradient steps, as a picture; scores of judgements on an axis of their own."""
    from matplotlib.figure import Figure

    losses, scores = [row for row in curve if "loss" in row], [row for row in curve if "score" in row]
    axes = (figure := Figure(figsize=(6, 3.5), layout="constrained")).subplots()
    draw = axes.semilogy if all(row["loss"] > 0 for row in losses) else axes.plot  # log-likelihoods go below 0
    draw([row["step"] for row in losses], [row["loss"] for row in losses])
    axes.set(xlabel="gradient step", ylabel="loss", title="training loss")
    axes.grid(alpha=0.3)
    if scores:
        right = axes.twinx()
        right.plot([row["step"] for row in scores], [row["score"] for row in scores], "o-", color="tab:orange", ms=3)
        right.set_ylabel("score of judgements", color="tab:orange")
    figure.savefig(path, dpi=120)


@contextmanager
def loggers(names: Sequence[str], folder: Path, recipe: Mapping[str, Any]) -> Iterator[Callable[[Row], None]]:
    """A function that hands a row to all loggers; their files go into `folder`.

    Raises `InputError` when a logger's library is not installed.
    """
    with ExitStack() as stack:
        sinks = [stack.enter_context(LOGGERS[name](folder, recipe)) for name in names]

        def log(row: Row) -> None:
            values = {key: value for key, value in row.items() if key != "step"}
            for sink in sinks:
                sink(values, row["step"])

        yield log


@contextmanager
def _tensorboard(folder: Path, recipe: Mapping[str, Any]) -> Iterator[Callable[[Row, int], None]]:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise InputError("the logger tensorboard is not installed: pip install tensorboard") from error
    with SummaryWriter(str(folder / "tensorboard")) as writer:
        writer.add_text("recipe", f"```\n{json.dumps(recipe, indent=2)}\n```")

        def log(values: Row, step: int) -> None:
            for key, value in values.items():
                writer.add_scalar(f"train/{key}", value, step)
            writer.flush()

        yield log


@contextmanager
def _wandb(folder: Path, recipe: Mapping[str, Any]) -> Iterator[Callable[[Row, int], None]]:
    try:
        import wandb
    except ImportError as error:
        raise InputError("the logger wandb is not installed: pip install wandb") from error
    with wandb.init(project="lfd", dir=str(folder), config=dict(recipe)) as run:
        yield lambda values, step: run.log(dict(values), step=step)


LOGGERS = {"tensorboard": _tensorboard, "wandb": _wandb}
