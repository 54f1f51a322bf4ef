"""Histories, chunks, recurrence and randomness of the cloned policies."""

from typing import Any

import pytest
import torch

from lfd.core.errors import RecipeError, UnknownName
from lfd.policies.registry import make_config


def policy_of(table: dict[str, Any]) -> Any:
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class

    features = {"observation.state": PolicyFeature(FeatureType.STATE, (3,))}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
    config = make_config(table, "test", input_features=features, output_features=outputs)
    torch.manual_seed(0)
    return get_policy_class(config.type)(config).eval().requires_grad_(False)


def seen(*rows: float) -> dict[str, torch.Tensor]:
    return {"observation.state": torch.tensor([rows])}


def test_a_policy_with_history_acts_on_the_window_that_it_was_trained_on() -> None:
    """Before the first observation stand copies of it; later the oldest leaves."""
    policy = policy_of({"type": "bc_mlp", "n_obs_steps": 3, "hidden_sizes": [8]})
    states = torch.randn(5, 3)
    for t in range(5):
        window = states[[max(t - 2, 0), max(t - 1, 0), t]].unsqueeze(0)
        expected = policy.raw({"observation.state": window})[:, -1, 0]
        torch.testing.assert_close(policy.select_action({"observation.state": states[t : t + 1]}), expected)
    policy.reset()
    window = states[[4, 4, 4]].unsqueeze(0)
    expected = policy.raw({"observation.state": window})[:, -1, 0]
    torch.testing.assert_close(policy.select_action({"observation.state": states[4:]}), expected)


def test_a_chunk_is_executed_in_order_and_then_made_anew() -> None:
    policy = policy_of({"type": "bc_mlp", "chunk_size": 4, "n_action_steps": 3, "hidden_sizes": [8]})
    first, second = seen(0.1, 0.2, 0.3), seen(1.0, 1.0, 1.0)
    chunk = policy.raw(first)[0, -1]
    for t in range(3):  # what is seen in between does not matter
        torch.testing.assert_close(policy.select_action(first if t == 0 else second)[0], chunk[t])
    torch.testing.assert_close(policy.select_action(second)[0], policy.raw(second)[0, -1, 0])


@pytest.mark.parametrize("chunk", [1, 3])
def test_the_loss_of_a_window_is_that_of_its_positions_one_by_one(chunk) -> None:
    """Position j of an LSTM is compared with the actions from frame j on; padding does not count."""
    n = 4
    policy = policy_of({"type": "bc_rnn", "n_obs_steps": n, "chunk_size": chunk, "lstm_units": 8, "lstm_layers": 1})
    assert policy.config.action_delta_indices == list(range(1 - n, chunk))
    window, actions = torch.randn(2, n, 3), torch.randn(2, n - 1 + chunk, 2)
    pad = torch.zeros(2, n - 1 + chunk, dtype=torch.bool)
    pad[0, :2] = pad[1, -1] = True
    with torch.no_grad():
        loss, _ = policy({"observation.state": window, "action": actions, "action_is_pad": pad})
        raw = policy.raw({"observation.state": window})
    total, counted = 0.0, 0
    for b in range(2):
        for j in range(n):
            for c in range(chunk):
                if not pad[b, j + c]:
                    total, counted = total + float((raw[b, j, c] - actions[b, j + c]).square().mean()), counted + 1
    assert float(loss) == pytest.approx(total / counted, rel=1e-5)


def test_an_lstm_reads_its_window_step_by_step() -> None:
    policy = policy_of({"type": "bc_rnn", "n_obs_steps": 4, "lstm_units": 8, "lstm_layers": 2})
    window = torch.randn(1, 4, 3)
    state, outputs = None, []
    for t in range(4):
        out, state = policy.lstm(window[:, t : t + 1], state)
        outputs.append(policy.net(out)[:, 0])
    torch.testing.assert_close(policy.raw({"observation.state": window})[:, :, 0], torch.stack(outputs, 1))


def test_sampling_draws_from_the_head_and_the_mode_does_not() -> None:
    table = {"type": "bc_mlp", "head": "gaussian", "loss": "nll", "hidden_sizes": [8]}
    steady, drawn = policy_of(table), policy_of({**table, "sample": True})
    assert steady.is_memoryless
    assert not drawn.is_memoryless
    mean, std = steady.head.distribution(steady.raw(seen(0.1, 0.2, 0.3))[:, 0, 0])
    torch.testing.assert_close(steady.select_action(seen(0.1, 0.2, 0.3)), mean)
    draws = torch.stack([drawn.select_action(seen(0.1, 0.2, 0.3))[0] for _ in range(2000)])
    torch.testing.assert_close(draws.mean(0), mean[0], atol=float(std.max()) * 0.1, rtol=0)
    torch.testing.assert_close(draws.std(0), std[0], rtol=0.1, atol=0)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (
            {"type": "bc_mlp", "chunk_size": 2, "n_action_steps": 3},
            "n_action_steps = 3 of a chunk of 2: give at most that",
        ),
        ({"type": "bc_mlp", "n_obs_steps": 0}, "n_obs_steps = 0: must be at least 1"),
        ({"type": "bc_mlp", "hidden_sizes": [8, 0]}, "every layer needs at least one unit"),
        ({"type": "bc_rnn", "lstm_units": 0}, "lstm_units = 0: must be at least 1"),
        ({"type": "act", "chunk_size": "many"}, "test of type act: .*chunk_size"),
        ({"type": "bc_mlp", "p": 0.5, "loss": "p_norm"}, "p = 0.5: must be at least 1"),
    ],
)
def test_values_that_do_not_fit(table, sentence) -> None:
    with pytest.raises(RecipeError, match=sentence):
        make_config(table, "test")


def test_names_that_do_not_exist() -> None:
    with pytest.raises(
        UnknownName, match="unknown policy type in test: 'bc_mpl'; known: act, bc_mlp, bc_rnn, diffusion"
    ):
        make_config({"type": "bc_mpl"}, "test")
    with pytest.raises(UnknownName, match="unknown key in test: 'hidden'; known: .*hidden_sizes"):
        make_config({"type": "bc_mlp", "hidden": [3]}, "test")
    with pytest.raises(UnknownName, match="loss of the point head .*: 'nll'; known: huber, mse, p_norm"):
        make_config({"type": "bc_mlp", "loss": "nll"}, "test")


RNN = {"type": "bc_rnn", "n_obs_steps": 3, "lstm_units": 8, "head": "mixture", "loss": "nll", "sample": True}
ACT = {"type": "act", "chunk_size": 3, "n_action_steps": 2, "dim_model": 16, "n_heads": 2, "dim_feedforward": 16}
DIFFUSION = {
    "type": "diffusion", "horizon": 8, "n_action_steps": 3, "drop_n_last_frames": 4, "down_dims": [8, 16],
    "num_train_timesteps": 4, "n_groups": 4,
}  # fmt: skip


@pytest.mark.parametrize("table", [RNN, ACT, DIFFUSION], ids=lambda table: table["type"])
def test_what_a_policy_does_in_a_world_depends_on_that_world_alone(thread, lift_world, tmp_path, rng, table) -> None:
    """Memories and draws of two worlds, asked in turns, are those of each alone, also with LeRobot's policies."""
    import numpy as np

    from lfd.core.recipe import build, load_toml
    from lfd.policies.acting import LearnedPolicy
    from lfd.train.behavior_cloning import train
    from lfd.train.recipe import TrainRecipe
    from tests.conftest import BC

    tables = load_toml(BC, ("policy", "train", "eval"))
    train(
        table, build(TrainRecipe, tables["train"] | {"steps": 2}, "test"), thread.dataset, tmp_path / "p", tables=tables
    )
    first = lift_world.reset(rng)
    views = [[{k: v + s for k, v in first.items()} for s in rng.normal(scale=0.1, size=4)] for _ in range(2)]
    both, alone = (LearnedPolicy(tmp_path / "p", lift_world.spec) for _ in range(2))
    for place in (0, 1):
        both.reset(np.random.default_rng(place), place)
    together = [both.act_many([views[0][t], views[1][t]], [0, 1]) for t in range(4)]
    for place in (1, 0):
        alone.reset(np.random.default_rng(place))
        for t in range(4):
            np.testing.assert_array_equal(together[t][place].action, alone.act(views[place][t]).action)
