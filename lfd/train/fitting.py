"""A whole training: descend, report, judge, keep the best, save checkpoints, stop early."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lfd.core.protocols import Progress, silent
from lfd.train.descent import Descent

REPORTS = 100
"""Rows in the metrics of a training."""
Row = dict[str, Any]


@dataclass
class Course:
    """What a training has gone through; with the descent's state, all that it is gone on from."""

    curve: list[Row] = field(default_factory=list)
    """One row a report or judgement: step, and loss and learning_rate or score."""
    best: list[Tensor] = field(default_factory=list)
    """The best weights so far, as `FlatParameters.values`; none before the first judgement."""
    best_step: int = 0
    best_score: float = -math.inf
    misses: int = 0
    """Judgements since the best."""
    total: float = 0.0
    """Sum of the losses since the last report."""
    counted: int = 0
    """Steps since the last report."""

    def judged(self, descent: Descent, score: float) -> None:
        """Take a judgement of the present weights: higher is better, of two equal ones the later."""
        self.curve.append({"step": descent.step, "score": score})
        if score >= self.best_score:
            self.best_score, self.best_step, self.misses = score, descent.step, 0
            self.best = [values.clone() for values in descent.flat.values]
        else:
            self.misses += 1


def fit(
    descent: Descent,
    *,
    course: Course | None = None,
    judge: Callable[[], float] | None = None,
    save: Callable[[Course], None] | None = None,
    report: Callable[[Row], None] | None = None,
    progress: Progress = silent,
) -> Course:
    """Train `descent.policy` to the end of its recipe; it is left with the best weights, or the last without a judge.

    `judge` scores the policy's present weights, `save` makes a checkpoint, `report` gets each row of the curve. With
    the `course` that a checkpoint kept, and a descent in its state, training goes on where it was.

    Raises `TrainingError` when a loss is not finite.
    """
    recipe, course = descent.recipe, course or Course()
    every = {"report": math.ceil(recipe.steps / REPORTS), "save": recipe.checkpoint_every, "judge": recipe.judge_every}
    with progress("train", recipe.steps) as bar:
        bar.advance(descent.step)
        while descent.step < recipe.steps and not _is_over(course, recipe.patience):
            begin = descent.step
            until = min([recipe.steps, *((begin // n + 1) * n for n in every.values() if n)])
            loss = descent.advance(until)
            course.total, course.counted = course.total + loss * (until - begin), course.counted + until - begin
            if until % every["report"] == 0 or until == recipe.steps:
                row = {"step": until, "loss": course.total / course.counted, "learning_rate": recipe.step_size(until)}
                course.curve.append(row)
                course.total, course.counted = 0.0, 0
                if report:
                    report(row)
            if judge and every["judge"] and (until % every["judge"] == 0 or until == recipe.steps):
                with descent.averaged():
                    course.judged(descent, judge())
                if report:
                    report(course.curve[-1])
            bar.advance(until - begin, note=_note(course))
            if save and until % every["save"] == 0 and until < recipe.steps:
                save(course)
    _leave_best(descent, course)
    return course


def _is_over(course: Course, patience: int) -> bool:
    return 0 < patience <= course.misses


def _leave_best(descent: Descent, course: Course) -> None:
    """Give the policy the weights that are kept."""
    with descent.averaged():
        kept = course.best or [values.clone() for values in descent.flat.values]
    for values, best in zip(descent.flat.values, kept, strict=True):
        values.copy_(best)
    descent.policy.eval()


def _note(course: Course) -> str:
    losses = [row["loss"] for row in course.curve if "loss" in row]
    note = f"loss {losses[-1]:.4f}" if losses else ""
    return note + (f", best {course.best_score:.3g} at {course.best_step}" if course.best else "")


def last_loss(course: Course) -> float:
    """The loss of the last report."""
    return next(row["loss"] for row in reversed(course.curve) if "loss" in row)


def tensors_of(course: Course) -> dict[str, Tensor]:
    """The tensors of a course, for a checkpoint; what else it holds is plain."""
    return {f"best.{i}": values for i, values in enumerate(course.best)}


def plain_of(course: Course) -> dict[str, Any]:
    """What a course holds beside tensors, as JSON takes it."""
    plain = {key: value for key, value in vars(course).items() if key != "best"}
    plain["best_score"] = None if math.isinf(course.best_score) else course.best_score
    return plain


def course_of(plain: dict[str, Any], tensors: dict[str, torch.Tensor]) -> Course:
    """The course that `plain_of` and `tensors_of` kept."""
    best = [tensors[f"best.{i}"] for i in range(sum(key.startswith("best.") for key in tensors))]
    score = -math.inf if plain["best_score"] is None else plain["best_score"]
    return Course(**{**plain, "best_score": score, "best": best})
