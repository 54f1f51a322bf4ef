import numpy as np
import pytest
import torch

from lfd.core.errors import PolicyError
from lfd.data.frames import load_frames
from lfd.policies.acting import LearnedPolicy, load_policy


def test_lerobots_own_functions_load_and_run_the_policy(thread) -> None:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    import lfd.policies  # noqa: F401  (registers the configuration)

    config = PreTrainedConfig.from_pretrained(thread.policy)
    assert config.type == "bc_mlp"
    policy = get_policy_class(config.type).from_pretrained(thread.policy)
    before, after = make_pre_post_processors(config, pretrained_path=str(thread.policy))
    frames = load_frames(thread.dataset)
    row = {key: values[3] for key, values in frames.columns.items() if key != "action"}
    action = after(policy.select_action(before(row)))
    assert action.shape == (1, 7)


def test_the_policy_is_the_network_of_its_docstring_on_normalised_inputs(thread) -> None:
    """relu layers written out by hand, with the mean and std of the dataset."""
    frames = load_frames(thread.dataset)
    policy, before, after = load_policy(thread.policy)
    row = {key: values[3] for key, values in frames.columns.items() if key != "action"}
    inputs = [(row[key] - frames.stats[key]["mean"]) / (frames.stats[key]["std"] + 1e-8) for key in sorted(row)]
    x = torch.cat(inputs)
    weights = dict(policy.named_parameters())
    for layer in (0, 2):
        x = torch.relu(weights[f"net.{layer}.weight"] @ x + weights[f"net.{layer}.bias"])
    expected = weights["net.4.weight"] @ x + weights["net.4.bias"]
    torch.testing.assert_close(after(policy.select_action(before(row)))[0], expected, rtol=1e-4, atol=1e-5)


def test_the_loss_is_the_mean_square_over_components(thread) -> None:
    frames = load_frames(thread.dataset)
    policy, before, _ = load_policy(thread.policy)
    batch = before(dict(frames.columns))
    with torch.no_grad():
        loss, _ = policy.forward(batch)
        away = policy.raw(batch)[:, 0, 0] - batch["action"]
    assert float(loss) == pytest.approx(float((away.norm(dim=1) ** 2 / away.shape[1]).mean()), rel=1e-6)


def test_the_policy_acts_by_names_not_by_order(thread, lift_world) -> None:
    policy = LearnedPolicy(thread.policy, lift_world.spec)
    seen = lift_world.reset(np.random.default_rng(0))
    policy.reset(np.random.default_rng(0))
    shuffled = dict(reversed(list(seen.items())))
    np.testing.assert_array_equal(policy.act(seen).action, policy.act(shuffled).action)


def test_a_policy_for_another_robot_or_rate_is_refused(thread) -> None:
    from lfd import make_world

    with pytest.raises(PolicyError, match="was trained for control_hz 20, the world has 10"):
        LearnedPolicy(thread.policy, make_world("Lift", "panda", 10).spec)


def test_folders_that_are_no_policy(thread, lift_world, tmp_path) -> None:
    import shutil

    with pytest.raises(PolicyError, match="no policy folder"):
        LearnedPolicy(tmp_path / "nothing", lift_world.spec)
    with pytest.raises(PolicyError, match="is a dataset, no policy; `lfd train RECIPE"):
        LearnedPolicy(thread.dataset, lift_world.spec)
    copy = shutil.copytree(thread.policy, tmp_path / "policy")
    (copy / "model.safetensors").write_bytes(b"\x80\x04garbage that could be a pickle")
    with pytest.raises(PolicyError, match="cannot be loaded as a LeRobot policy"):
        LearnedPolicy(copy, lift_world.spec)
    (copy / "model.safetensors").unlink()
    with pytest.raises(PolicyError, match=r"it has no model.safetensors"):
        LearnedPolicy(copy, lift_world.spec)
