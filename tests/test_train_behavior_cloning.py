import json

import pytest
import torch

from lfd.core.errors import RecipeError, TrainingError
from lfd.core.protocols import silent
from lfd.core.recipe import build, load_toml
from lfd.train.behavior_cloning import TrainRecipe, fit, train
from tests.conftest import BC


def recipe(**changes) -> TrainRecipe:
    tables = load_toml(BC, ("policy", "train", "eval"))
    return build(TrainRecipe, tables["train"] | changes, "test")


class Affine(torch.nn.Module):
    """A policy that can fit an affine expert exactly."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(3, 2)

    def forward(self, batch):
        return torch.nn.functional.mse_loss(self.layer(batch["x"]), batch["action"]), {}


def test_training_finds_the_affine_expert() -> None:
    torch.manual_seed(0)
    expert, x = torch.nn.Linear(3, 2), torch.randn(200, 3)
    rows = {"x": x, "action": expert(x).detach()}
    policy = Affine()
    curve = fit(policy, rows, recipe(steps=2000, learning_rate=1e-2, weight_decay=0.0), silent)
    torch.testing.assert_close(policy.layer.weight, expert.weight, atol=1e-3, rtol=0)
    torch.testing.assert_close(policy.layer.bias, expert.bias, atol=1e-3, rtol=0)
    assert curve[-1]["step"] == 2000
    assert curve[-1]["loss"] < 1e-6 < curve[0]["loss"]
    assert curve[-1]["learning_rate"] == pytest.approx(0)


def test_a_loss_that_is_not_finite_stops_the_training() -> None:
    rows = {"x": torch.full((10, 3), 1e30), "action": torch.zeros(10, 2)}
    with pytest.raises(TrainingError, match="the loss is (inf|nan) at step 1; try a smaller train.learning_rate"):
        fit(Affine(), rows, recipe(steps=5), silent)


def test_the_same_seed_gives_the_same_weights(thread, tmp_path) -> None:
    tables = load_toml(BC, ("policy", "train", "eval"))
    for name in ("one", "two"):
        train(tables["policy"], recipe(steps=3), thread.dataset, tmp_path / name, tables=tables)
    weights = [(tmp_path / name / "model.safetensors").read_bytes() for name in ("one", "two")]
    assert weights[0] == weights[1]


def test_the_policy_folder_is_complete(thread) -> None:
    names = {path.name for path in thread.policy.iterdir()}
    assert {"config.json", "model.safetensors", "policy_preprocessor.json", "manifest.json", "loss.png"} <= names
    manifest = json.loads((thread.policy / "manifest.json").read_text())
    assert manifest["recipe"]["train"]["steps"] == 20
    assert next(iter(manifest["parents"])) == str(thread.dataset)
    curve = [json.loads(line) for line in (thread.policy / "metrics.jsonl").read_text().splitlines()]
    assert curve[-1]["loss"] < curve[0]["loss"]
    assert not json.loads((thread.policy / "config.json").read_text())["push_to_hub"]


def test_values_out_of_range_are_said() -> None:
    with pytest.raises(RecipeError, match="test steps = 0: must be greater than 0"):
        recipe(steps=0)
    with pytest.raises(RecipeError, match=r"test device = 'tpu': this machine has .*cpu"):
        recipe(device="tpu")
