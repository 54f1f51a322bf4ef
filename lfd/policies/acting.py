"""A trained policy, loaded from its folder, that acts in a world."""

import io
import os
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lfd.core.artifact import read_manifest
from lfd.core.errors import PolicyError
from lfd.core.protocols import Decision, Observation, WorldSpec

WEIGHTS = "model.safetensors"
ROWS = 8
"""Observations that a network is asked for at a time, filled up with copies: matrix products of another size may
round differently, and what a policy does must not depend on how many worlds there are."""


class LearnedPolicy:
    """A policy folder as LeRobot saves it, with lfd's manifest.

    The manifest names the components of each input, such as `ee_pos.x`; they are looked up in the world's
    observation. Weights are safetensors; nothing is unpickled.

    Raises `PolicyError` for a folder that cannot be loaded or a policy made for another robot or controller.
    """

    def __init__(self, folder: Path, spec: WorldSpec):
        about = about_policy(folder)
        for key in ("robot", "controller", "control_hz"):
            if about[key] != getattr(spec, key):
                raise PolicyError(f"{folder} was trained for {key} {about[key]}, the world has {getattr(spec, key)}")
        self._sources = {f: [_source(n, spec, folder) for n in names] for f, names in about["features"].items()}
        self._policy, self._before, self._after = load_policy(folder)
        self.name = str(about["policy"])

    def reset(self, rng: np.random.Generator) -> None:
        torch.manual_seed(int(rng.integers(2**63)))
        self._policy.reset()

    def act(self, observation: Observation) -> Decision:
        return self.act_many([observation])[0]

    def act_many(self, observations: Sequence[Observation]) -> list[Decision]:
        """Decisions for several observations; each is what `act` gives for it alone, bit for bit."""
        decisions = []
        for begin in range(0, len(observations), ROWS):
            some = list(observations[begin : begin + ROWS])
            filled = some + some[:1] * (ROWS - len(some))
            batch = {
                feature: torch.tensor([[seen[name][i] for name, i in sources] for seen in filled], dtype=torch.float32)
                for feature, sources in self._sources.items()
            }
            actions = self._after(self._policy.select_action(self._before(batch))).numpy().astype(np.float64)
            decisions += [Decision(action) for action in actions[: len(some)]]
        return decisions


class AskedOnce:
    """A learned policy for many worlds, asked once for all of them."""

    def __init__(self, policy: LearnedPolicy):
        self._policy, self.name = policy, policy.name

    def reset(self, place: int, rng: np.random.Generator) -> None:
        self._policy.reset(rng)

    def act(self, places: Sequence[int], observations: Sequence[Observation]) -> Sequence[Decision]:
        return self._policy.act_many(observations)


def load_policy(folder: Path) -> tuple[Any, Any, Any]:
    """LeRobot's policy and its pre- and post-processor.

    Raises `PolicyError` for a folder that holds none.
    """
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    for name in ("config.json", WEIGHTS):
        if not (folder / name).is_file():
            raise PolicyError(f"{folder} is no policy: it has no {name}; `lfd train RECIPE --out {folder}` makes one")
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from safetensors import SafetensorError

    try:
        config = PreTrainedConfig.from_pretrained(folder)
        with redirect_stdout(io.StringIO()):  # it prints where it loads from
            policy = get_policy_class(config.type).from_pretrained(folder, config=config, strict=True)
        before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    except (ValueError, KeyError, OSError, RuntimeError, SafetensorError) as error:
        raise PolicyError(f"{folder} cannot be loaded as a LeRobot policy ({error}); train it again") from error
    return policy, before, after


def about_policy(folder: Path) -> dict[str, Any]:
    """The manifest of a policy folder.

    Raises `PolicyError` when there is none.
    """
    if not folder.is_dir():
        raise PolicyError(f"no policy folder {folder}; `lfd train RECIPE --out {folder}` makes one")
    about = read_manifest(folder)
    if about is None or about.get("kind") != "policy":
        raise PolicyError(f"{folder} is no policy of lfd: its manifest.json is missing or of another kind")
    return about


def _source(component: str, spec: WorldSpec, folder: Path) -> tuple[str, int]:
    name, _, label = component.partition(".")
    if label not in spec.labels.get(name, ()):
        raise PolicyError(f"{folder} needs the observation {component!r}, which {spec.task} with {spec.robot} lacks")
    return name, spec.labels[name].index(label)
