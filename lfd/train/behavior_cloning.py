"""The train stage: behaviour cloning, supervised learning on the demonstrated states (chapter 10.2).

    pi_hat = argmin_pi  sum_xi sum_{x in xi}  L(pi(x), pi*(x))

The way down: `train` prepares, `lfd.train.fitting.fit` reports and judges, `lfd.train.descent.Descent.advance` takes
the gradient steps, the policy's `forward` computes L.
"""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from lfd.core.artifact import check_output, heal, new_folder, read_manifest, sha256, write_manifest
from lfd.core.errors import DatasetError, OutputError
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import as_table
from lfd.data.frames import Frames, load_frames
from lfd.policies.acting import about_policy, load_policy
from lfd.policies.registry import make_policy
from lfd.policies.saving import save_policy
from lfd.train.checkpoint import CHECKPOINT, load_checkpoint, save_checkpoint, training_folder
from lfd.train.compatibility import check_policy, check_robot
from lfd.train.curves import loggers, write_metrics
from lfd.train.descent import Descent
from lfd.train.fitting import Course, Row, fit, last_loss
from lfd.train.processes import joined
from lfd.train.recipe import TrainRecipe
from lfd.train.training_data import TrainingData

Judge = Callable[[Path], float]
"""Scores a policy folder; higher is better."""


@dataclass(frozen=True)
class Trained:
    """What a run of the train stage did."""

    steps: int
    """Gradient steps taken; less than asked for after an early stop."""
    loss: float
    """Mean training loss over the last hundredth of the steps."""
    frames: int
    parameters: int
    best_step: int
    """Gradient step whose weights were kept."""
    score: float | None
    """Their judgement: minus the loss on validation episodes, or the success rate of rollouts; none without either."""


def train(
    policy_table: dict[str, Any],
    recipe: TrainRecipe,
    dataset: Path,
    out: Path,
    *,
    tables: Mapping[str, Any],
    init: Path | None = None,
    judge: Judge | None = None,
    report: Callable[[Row], None] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Trained:
    """Train a policy on `dataset` and save it into the folder `out`, complete, as LeRobot does.

    Weights begin with those of the policy `init`, or at random. `judge` makes the judgements by rollouts that the
    recipe may ask for, `report` gets each row of the curve. Checkpoints are kept in `OUT.training` until `out` is
    there; with `resume` a training goes on from the last one, to the same weights bit for bit (on a CPU).

    Raises `DatasetError` for a dataset that cannot be used or does not fit, `TrainingError` when the loss is not
    finite (the last checkpoint stays), `OutputError` when `out` or an interrupted training exists.
    """
    frames, about = _checked(dataset, init, progress)
    _check_place(out, resume=resume, overwrite=overwrite)
    threads = torch.get_num_threads()
    torch.set_num_threads(recipe.threads)
    try:
        with joined(recipe.device) as processes:
            torch.manual_seed(recipe.seed)
            policy, before, after = make_policy(policy_table, frames, recipe.device, "[policy]")
            if init is not None:
                before, after = _take_weights(policy, init)
            used = {**tables, "policy": policy_table, "train": as_table(recipe)}
            parents = {str(dataset): sha256(dataset)}

            def write_policy(folder: Path) -> None:
                save_policy(folder, policy, before, after)
                facts = {"policy": policy_table["type"], **_facts(frames, about)}
                write_manifest(folder, kind="policy", recipe=used, parents=parents, seed=recipe.seed, **facts)

            data = TrainingData(frames, policy.config, before, recipe)
            descent = Descent(policy, data.batch, data.train, recipe, episodes=data.episodes, processes=processes)
            identity = {**used, "dataset": parents[str(dataset)]}
            course = load_checkpoint(out, descent, identity) if resume else None
            course = _fit(descent, course, data, out, identity, write_policy, judge, report, progress)
            if processes.is_first:
                with new_folder(out, overwrite=overwrite) as part:
                    write_policy(part)
                    write_metrics(part, course.curve)
                    if recipe.loggers and (logs := training_folder(out) / "logs").is_dir():
                        shutil.copytree(logs, part / "logs")
                shutil.rmtree(training_folder(out), ignore_errors=True)
            processes.wait()
    finally:
        torch.set_num_threads(threads)
    judged = bool(course.best)
    return Trained(
        steps=descent.step,
        loss=last_loss(course),
        frames=len(frames),
        parameters=sum(p.numel() for p in policy.parameters()),
        best_step=course.best_step if judged else descent.step,
        score=course.best_score if judged else None,
    )


def _fit(
    descent: Descent,
    course: Course | None,
    data: TrainingData,
    out: Path,
    identity: Mapping[str, Any],
    write_policy: Callable[[Path], None],
    judge: Judge | None,
    report: Callable[[Row], None] | None,
    progress: Progress,
) -> Course:
    """Train to the end, with judgements, checkpoints and logs as the recipe asks for."""
    recipe, first = descent.recipe, descent.processes.is_first

    def score() -> float:
        if not recipe.judge_episodes:
            return -descent.loss(data.validation)
        assert judge is not None, "judge_episodes needs a judge"
        with TemporaryDirectory() as folder:
            write_policy(Path(folder))
            return judge(Path(folder))

    def save(course: Course) -> None:
        if first:
            save_checkpoint(out, descent, course, identity, write_policy)

    with loggers(recipe.loggers if first else (), training_folder(out) / "logs", identity) as log:

        def tell(row: Row) -> None:
            log(row)
            if report and first:
                report(row)

        return fit(
            descent,
            course=course,
            judge=score if recipe.judge_every else None,
            save=save,
            report=tell,
            progress=progress if first else silent,
        )


def _checked(dataset: Path, init: Path | None, progress: Progress) -> tuple[Frames, dict[str, Any]]:
    """The frames and the manifest of a dataset that fits its robot and the policy to begin with."""
    frames = load_frames(dataset, progress=progress)
    about = read_manifest(dataset)
    if about is None or about.get("kind") != "dataset":
        raise DatasetError(f"{dataset} has no manifest.json of a dataset; make it with `lfd convert`")
    check_robot(frames, about, dataset)
    if init is not None:
        check_policy(frames, about_policy(init), dataset, init)
    return frames, about


def _check_place(out: Path, *, resume: bool, overwrite: bool) -> None:
    """Refuse a place where a policy or an interrupted training is, before any work is done."""
    check_output(out, overwrite=overwrite)
    folder = training_folder(out)
    heal(folder / CHECKPOINT)
    if resume or not folder.is_dir():
        return
    if not overwrite and (folder / CHECKPOINT).is_dir():
        raise OutputError(
            f"{folder} holds a training that was interrupted: go on with it with --resume, or add --overwrite to begin "
            "anew"
        )
    shutil.rmtree(folder)


def _facts(frames: Frames, about: Mapping[str, Any]) -> dict[str, Any]:
    """What a policy must know of the robot and the numbers that it was made for."""
    return {
        **{key: about[key] for key in ("robot", "controller", "task", "control_hz")},
        "features": {key: list(names) for key, names in frames.names.items() if key != "action"},
        "action": list(frames.names["action"]),
        "units": {key: list(units) for key, units in frames.units.items()},
        "cameras": {key: list(pictures.shape[2:]) for key, pictures in frames.images.items()},
    }


def _take_weights(policy: Any, init: Path) -> tuple[Any, Any]:
    """Begin with the weights of another policy of the same build; returns its processors, which they belong to.

    Raises `DatasetError` when they do not fit.
    """
    other, before, after = load_policy(init)
    ours, theirs = policy.state_dict(), other.state_dict()
    if {k: v.shape for k, v in ours.items()} != {k: v.shape for k, v in theirs.items()}:
        raise DatasetError(
            f"the network of {init} is built otherwise than the recipe's; begin with one of the same recipe"
        )
    policy.load_state_dict(theirs)
    return before, after
