import copy
import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from lfd.core.errors import RecipeError, TrainingError, UnknownName
from lfd.core.recipe import build, load_toml
from lfd.train.descent import Descent
from lfd.train.fitting import Course, course_of, fit, plain_of, tensors_of
from lfd.train.recipe import TrainRecipe
from tests.conftest import BC


def recipe(**changes) -> TrainRecipe:
    return build(TrainRecipe, load_toml(BC, ("policy", "train", "eval"))["train"] | changes, "test")


class Affine(torch.nn.Module):
    """A policy that can fit an affine expert exactly."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(3, 2)

    def get_optim_params(self) -> Any:
        return self.parameters()

    def forward(self, batch):
        return torch.nn.functional.mse_loss(self.layer(batch["x"]), batch["action"]), {}


def descent_of(rows, used: TrainRecipe, policy=None) -> Descent:
    torch.manual_seed(used.seed + 1)
    policy = policy or Affine()
    frames = torch.arange(len(rows["x"]))
    return Descent(policy, lambda index: {k: v[index] for k, v in rows.items()}, frames, used)


@pytest.fixture
def rows():
    torch.manual_seed(0)
    expert, x = torch.nn.Linear(3, 2), torch.randn(200, 3)
    return {"x": x, "action": expert(x).detach()}, expert


def test_training_finds_the_affine_expert(rows) -> None:
    rows, expert = rows
    descent = descent_of(rows, recipe(steps=1500, learning_rate=1e-2, weight_decay=0.0, batch_size=64))
    course = fit(descent)
    torch.testing.assert_close(descent.policy.layer.weight, expert.weight, atol=1e-3, rtol=0)
    torch.testing.assert_close(descent.policy.layer.bias, expert.bias, atol=1e-3, rtol=0)
    assert course.curve[-1]["step"] == 1500
    assert course.curve[-1]["loss"] < 1e-6 < course.curve[0]["loss"]
    assert course.curve[-1]["learning_rate"] == pytest.approx(0)


@pytest.mark.parametrize("clip", [1e9, 0.05])
def test_the_steps_are_those_of_torchs_adamw_with_clipping(rows, clip) -> None:
    """The flat vector against a plain loop over parameters."""
    rows, _ = rows
    used = recipe(
        steps=50,
        learning_rate=1e-2,
        weight_decay=0.1,
        batch_size=200,
        grad_clip=clip,
        schedule="linear",
        warmup_steps=5,
    )
    descent = descent_of(rows, used)
    torch.manual_seed(used.seed + 1)
    plain = Affine()
    adam = torch.optim.AdamW(plain.parameters(), lr=1.0, betas=(0.9, 0.999), weight_decay=0.1)
    for step in range(50):  # a batch of all rows: the order within it does not matter
        adam.param_groups[0]["lr"] = used.step_size(step)
        loss, _ = plain(rows)
        adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(plain.parameters(), clip)
        adam.step()
    descent.advance(50)
    for ours, theirs in zip(descent.policy.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_parameter_groups_keep_the_ratio_of_their_learning_rates(rows) -> None:
    rows, _ = rows

    class Grouped(Affine):
        class config:  # noqa: N801
            @staticmethod
            def get_optimizer_preset():
                from types import SimpleNamespace

                return SimpleNamespace(lr=1e-3)

        def get_optim_params(self) -> Any:
            return [{"params": [self.layer.weight]}, {"params": [self.layer.bias], "lr": 1e-4}]

    torch.manual_seed(1)
    policy = Grouped()
    before = copy.deepcopy(policy)
    descent_of(rows, recipe(steps=100, learning_rate=1e-2, weight_decay=0.0, schedule="constant"), policy).advance(1)
    moved = [(a - b).abs().max().item() for a, b in zip(policy.parameters(), before.parameters(), strict=True)]
    assert moved == pytest.approx([1e-2, 1e-3], rel=1e-3)  # Adam's first step is the learning rate


def test_the_average_is_the_recursion_written_out(rows) -> None:
    rows, _ = rows
    descent = descent_of(rows, recipe(steps=100, ema_decay=0.9, batch_size=32))
    expected = descent.flat.values[0].clone()
    for step in range(30):
        descent.advance(step + 1)
        decay = min(0.9, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * descent.flat.values[0]
    own = descent.flat.values[0].clone()
    with descent.averaged():
        torch.testing.assert_close(descent.flat.values[0], expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(descent.flat.values[0], own, rtol=0, atol=0)


def test_a_descent_in_a_kept_state_goes_the_same_way(rows) -> None:
    rows, _ = rows
    used = recipe(steps=100, ema_decay=0.9, batch_size=32)
    whole = descent_of(rows, used)
    whole.advance(37)
    state = whole.state()
    whole.advance(100)
    other = descent_of(rows, replace(used))
    other.load_state(state)
    other.advance(100)
    for a, b in zip(whole.policy.parameters(), other.policy.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_a_loss_that_is_not_finite_names_its_episodes(rows) -> None:
    rows, _ = rows
    rows["x"][17] = 1e38
    used = recipe(steps=50, batch_size=20)
    frames = torch.arange(200)
    descent = Descent(
        Affine(), lambda i: {k: v[i] for k, v in rows.items()}, frames, used,
        episodes=lambda index: sorted({int(i) // 10 for i in index}),
    )  # fmt: skip
    with pytest.raises(
        TrainingError, match=r"the loss is (inf|nan) at step \d+, in a batch of episodes .*\b1\b.*; try a smaller"
    ):
        fit(descent)


def test_judgements_keep_the_best_and_end_early(rows) -> None:
    rows, _ = rows
    scores = iter([0.2, 0.9, 0.9, 0.3, 0.4, 0.8])
    seen = []
    descent = descent_of(rows, recipe(steps=1000, judge_every=10, validation_fraction=0.1, patience=2, batch_size=32))

    def judge() -> float:
        seen.append(descent.flat.values[0].clone())
        return next(scores)

    course = fit(descent, judge=judge)
    assert (course.best_score, course.best_step) == (0.9, 30)  # of two equal ones the later
    assert descent.step == 50
    torch.testing.assert_close(descent.flat.values[0], seen[2], rtol=0, atol=0)


def test_a_course_survives_json(rows) -> None:
    import json

    rows, _ = rows
    descent, course = descent_of(rows, recipe(steps=10)), Course()
    assert course_of(json.loads(json.dumps(plain_of(course))), {}).best_score == -math.inf
    course.judged(descent, 0.5)
    again = course_of(json.loads(json.dumps(plain_of(course))), tensors_of(course))
    assert (again.best_score, again.best_step, again.curve) == (0.5, 0, [{"step": 0, "score": 0.5}])
    torch.testing.assert_close(again.best[0], course.best[0])


def test_step_sizes() -> None:
    used = recipe(steps=110, warmup_steps=10, learning_rate=1.0)
    assert [used.step_size(s) for s in (0, 9, 10, 60, 110)] == pytest.approx([1 / 11, 10 / 11, 1.0, 0.5, 0.0])
    assert replace(used, schedule="linear").step_size(35) == pytest.approx(0.75)
    assert replace(used, schedule="constant").step_size(100) == 1.0


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"steps": 0}, "test steps = 0: must be greater than 0"),
        ({"device": "tpu"}, "test device = 'tpu': this machine has .*cpu"),
        ({"ema_decay": 1.0}, "test ema_decay = 1.0: must be at least 0 and below 1"),
        ({"betas": [0.9]}, "expected two numbers"),
        ({"judge_every": 5}, "has nothing to judge by: set validation_fraction"),
        ({"patience": 5}, "patience = 5 counts judgements: set judge_every"),
        ({"intervention_weight": 0}, "must be at least 1"),
    ],
)
def test_values_out_of_range_are_said(change, sentence) -> None:
    with pytest.raises(RecipeError, match=sentence):
        recipe(**change)
    with pytest.raises(
        UnknownName, match="unknown schedule in test: 'cosin'; known: constant, cosine, linear. Did you mean"
    ):
        recipe(schedule="cosin")
