import json
import pickle
import shutil
import zipfile
from pathlib import Path

import pytest

from lfd.core.errors import PolicyError
from lfd.policies.safe_loading import PICKLES, check_no_pickle


def test_what_lfd_and_lerobot_save_is_let_through(thread) -> None:
    check_no_pickle(thread.policy)


@pytest.mark.parametrize("name", ["pytorch_model.bin", "model.pt", "model.PTH", "sub/policy.pkl", "last.ckpt"])
def test_a_pickle_is_refused_even_beside_safetensors(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"")
    (tmp_path / "model.safetensors").write_bytes(b"")
    with pytest.raises(PolicyError, match=f"holds {name}, a pickle, which can run any program when it is read"):
        check_no_pickle(tmp_path)


def test_what_torch_saves_by_default_is_known_as_a_pickle(tmp_path: Path) -> None:
    import torch

    path = tmp_path / "weights.pt"
    torch.save({"w": torch.zeros(1)}, path)
    assert any(name.endswith("data.pkl") for name in zipfile.ZipFile(path).namelist())
    assert path.suffix in PICKLES


def test_a_processor_that_names_a_class_is_refused_before_lerobot_would_call_it(thread, tmp_path: Path) -> None:
    """LeRobot imports the class and calls it with the file's arguments, which can be any program."""
    from lerobot.processor import PolicyProcessorPipeline

    folder, made = shutil.copytree(thread.policy, tmp_path / "policy"), tmp_path / "made"
    path = folder / "policy_preprocessor.json"
    content = json.loads(path.read_text())
    content["steps"].insert(0, {"class": "os.mkdir", "config": {"path": str(made)}})
    path.write_text(json.dumps(content))
    with pytest.raises(PolicyError, match=r"has the step 'os.mkdir', to be imported and called"):
        check_no_pickle(folder)
    assert not made.exists()
    with pytest.raises(TypeError, match="must inherit from ProcessorStep"):  # it is looked at afterwards
        PolicyProcessorPipeline.from_pretrained(folder, config_filename=path.name)
    assert made.exists()  # so the check is needed


@pytest.mark.parametrize("text", ["", "[]", '{"steps": 1}', '{"steps": ["x"]}'])
def test_a_processor_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "policy_preprocessor.json").write_text(text)
    with pytest.raises(PolicyError, match=r"is no processor of LeRobot's"):
        check_no_pickle(tmp_path)


class _Program:
    """Creates a folder when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.mkdir, (self.path,)


def test_safetensors_takes_no_pickle_for_weights(tmp_path: Path) -> None:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    path = tmp_path / "model.safetensors"
    path.write_bytes(pickle.dumps(_Program(tmp_path / "made")))
    with pytest.raises(SafetensorError):
        load_file(path)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("kind", ["bc_mlp", "act", "diffusion"])
def test_loading_a_policy_unpickles_nothing(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights, statistics and processors of a saved policy, read with unpickling made impossible."""
    if kind == "diffusion":
        pytest.importorskip("diffusers")
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

    import lfd.policies  # noqa: F401  (registers bc_mlp)

    small = {
        "bc_mlp": {},
        "act": {"chunk_size": 4, "n_action_steps": 4, "dim_model": 16, "n_heads": 2, "dim_feedforward": 16},
        "diffusion": {"down_dims": (16, 32)},
    }
    config = make_policy_config(kind, device="cpu", **small[kind])
    config.input_features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (3,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (2,)),
    }
    config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
    features = {**config.input_features, **config.output_features}
    stats = {
        key: {
            name: torch.full(feature.shape, value) for name, value in (("mean", 0), ("std", 1), ("min", -2), ("max", 2))
        }
        for key, feature in features.items()
    }
    made = [get_policy_class(kind)(config), *make_pre_post_processors(config, dataset_stats=stats)]
    for part in made:
        part.save_pretrained(tmp_path)
    check_no_pickle(tmp_path)

    def refuse(*given: object, **more: object) -> None:
        raise AssertionError("something was unpickled")

    for owner, name in ((torch, "load"), (pickle, "load"), (pickle, "loads"), (pickle, "Unpickler")):
        monkeypatch.setattr(owner, name, refuse)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    policy = get_policy_class(kind).from_pretrained(tmp_path, config=config, strict=True)
    make_pre_post_processors(config, pretrained_path=str(tmp_path))
    for name, values in made[0].state_dict().items():
        torch.testing.assert_close(policy.state_dict()[name], values)
