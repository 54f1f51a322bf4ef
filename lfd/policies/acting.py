"""A trained policy, loaded from its folder, that acts in a world."""

import copy
import io
import os
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8

from lfd.core.artifact import read_manifest
from lfd.core.channels import operands
from lfd.core.errors import PolicyError
from lfd.core.protocols import Decision, Observation, WorldSpec
from lfd.policies.adoption import about_foreign
from lfd.policies.safe_loading import check_no_pickle

WEIGHTS = "model.safetensors"
MADE_FOR = ("robot", "controller", "control_hz")
ROWS = 8
"""Observations that a network without memory is asked for at a time, filled up with copies: matrix products of another
size may round differently, and what a policy does must not depend on how many worlds there are."""


@runtime_checkable
class Eyes(Protocol):
    """What takes pictures: a world."""

    def pictures(self) -> Mapping[str, UInt8[np.ndarray, "H W 3"]]: ...


@dataclass
class _Memory:
    """What a policy remembers in one world: its own copy of everything but the weights, and of the random state."""

    policy: Any
    random: torch.Tensor


class LearnedPolicy:
    """A policy folder as LeRobot saves it, acting in one world or in many.

    The manifest (`about`, where it is known already) names the components of each input, such as `ee_pos.x`; they are
    looked up in the world's observation. Where the policy takes pictures, `eyes` are the worlds to take them from, by
    place. What it does in a world depends on that world and its generator alone. Weights are safetensors; nothing is
    unpickled.

    Raises `PolicyError` for a folder that cannot be loaded, or for a policy made for another robot, controller or
    rate, unless it is to be `forced`.
    """

    def __init__(
        self,
        folder: Path,
        spec: WorldSpec,
        *,
        about: Mapping[str, Any] | None = None,
        forced: bool = False,
        eyes: Sequence[Eyes] = (),
    ):
        about = about or about_policy(folder)
        for key in MADE_FOR:
            if about[key] != getattr(spec, key) and not forced:
                raise PolicyError(
                    f"{folder} was trained for {key} {about[key]}, the world has {getattr(spec, key)}; "
                    f"`lfd eval {folder} --robot {spec.robot} --force` runs it all the same"
                )
        self._sources = {f: [_source(n, spec, folder) for n in names] for f, names in about["features"].items()}
        self._cameras, self._eyes = about.get("cameras", {}), eyes
        self._policy, self._before, self._after = load_policy(folder)
        self._check_action(folder, spec)
        self.name = str(about["policy"])
        self._has_memory = not getattr(self._policy, "is_memoryless", False)
        self._memories: dict[int, _Memory] = {}

    def reset(self, rng: np.random.Generator, place: int = 0) -> None:
        """Begin an episode in the world number `place`."""
        seed = int(rng.integers(2**63))
        if self._has_memory:
            policy = _with_own_memory(self._policy)
            policy.reset()
            self._memories[place] = _Memory(policy, torch.Generator().manual_seed(seed).get_state())

    def act(self, observation: Observation) -> Decision:
        return self.act_many([observation])[0]

    def act_many(self, observations: Sequence[Observation], places: Sequence[int] | None = None) -> list[Decision]:
        """Decisions for the worlds number `places`; each is what `act` gives for it alone, bit for bit."""
        places = range(len(observations)) if places is None else places
        if self._has_memory:
            return [self._remembering(seen, place) for seen, place in zip(observations, places, strict=True)]
        decisions = []
        for begin in range(0, len(observations), ROWS):
            some = list(range(begin, min(begin + ROWS, len(observations))))
            filled = some + some[:1] * (ROWS - len(some))
            batch = self._batch([observations[i] for i in filled], [places[i] for i in filled])
            decisions += [Decision(action) for action in self._actions(self._policy, batch)[: len(some)]]
        return decisions

    def _remembering(self, observation: Observation, place: int) -> Decision:
        """A decision of a policy that remembers, or draws: with the memory and the random state of its world."""
        memory = self._memories[place]
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(memory.random)
            action = self._actions(memory.policy, self._batch([observation], [place]))[0]
            memory.random = torch.get_rng_state()
        return Decision(action)

    def _actions(self, policy: Any, batch: dict[str, torch.Tensor]) -> np.ndarray:
        return self._after(policy.select_action(self._before(batch))).cpu().numpy().astype(np.float64)

    def _batch(self, observations: Sequence[Observation], places: Sequence[int]) -> dict[str, torch.Tensor]:
        batch = {
            feature: torch.tensor(
                [[_number(seen, *source) for source in sources] for seen in observations], dtype=torch.float32
            )
            for feature, sources in self._sources.items()
        }
        if self._cameras:
            looks = {place: self._eyes[place].pictures() for place in set(places)}
            for feature in self._cameras:
                views = np.stack([looks[place][camera_of(feature)] for place in places])
                batch[feature] = torch.from_numpy(views).permute(0, 3, 1, 2).float() / 255
        return batch

    def _check_action(self, folder: Path, spec: WorldSpec) -> None:
        has, wants = self._policy.config.action_feature.shape, (len(spec.labels["action"]),)
        if tuple(has) != wants:
            raise PolicyError(f"{folder} gives actions of {has[0]} numbers, {spec.robot} takes {wants[0]}")


class AskedOnce:
    """A learned policy for many worlds, asked once for all of them."""

    def __init__(self, policy: LearnedPolicy):
        self._policy, self.name = policy, policy.name

    def reset(self, place: int, rng: np.random.Generator) -> None:
        self._policy.reset(rng, place)

    def act(self, places: Sequence[int], observations: Sequence[Observation]) -> Sequence[Decision]:
        return self._policy.act_many(observations, places)


def load_policy(folder: Path) -> tuple[Any, Any, Any]:
    """LeRobot's policy and its pre- and post-processor.

    Raises `PolicyError` for a folder that holds none, or a pickle.
    """
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    check_no_pickle(folder)
    for name in ("config.json", WEIGHTS):
        if not (folder / name).is_file():
            raise PolicyError(f"{folder} is no policy: it has no {name}; `lfd train RECIPE --out {folder}` makes one")
    from draccus.utils import DecodingError
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from safetensors import SafetensorError

    try:
        config = PreTrainedConfig.from_pretrained(folder)
        if hasattr(config, "pretrained_backbone_weights"):
            # model.safetensors has them; torchvision would download a file and unpickle it
            setattr(config, "pretrained_backbone_weights", None)  # noqa: B010 (a field of some configurations)
        with redirect_stdout(io.StringIO()):  # it prints where it loads from
            policy = get_policy_class(config.type).from_pretrained(folder, config=config, strict=True)
        before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    except (ValueError, KeyError, OSError, RuntimeError, ImportError, SafetensorError, DecodingError) as error:
        raise PolicyError(f"{folder} cannot be loaded as a LeRobot policy ({error}); train it again") from error
    return policy, before, after


def about_policy(folder: Path, dataset: Path | None = None) -> dict[str, Any]:
    """The manifest of a policy folder; for one that LeRobot trained, what it and its `dataset` say instead.

    Raises `PolicyError` when there is none.
    """
    if not folder.is_dir():
        raise PolicyError(f"no policy folder {folder}; `lfd train RECIPE --out {folder}` makes one")
    check_no_pickle(folder)
    about = read_manifest(folder)
    if about is None:
        return about_foreign(folder, dataset)
    if about.get("kind") != "policy":
        raise PolicyError(f"{folder} is a {about.get('kind')}, no policy; `lfd train RECIPE --out DIR` makes one")
    return about


def camera_of(feature: str) -> str:
    """The camera whose pictures a feature holds."""
    return feature.rpartition(".")[2]


def _with_own_memory(policy: Any) -> Any:
    """A copy of a policy that shares its weights and nothing else."""
    shared = {id(tensor): tensor for tensor in (*policy.parameters(), *policy.buffers())}
    return copy.deepcopy(policy, shared)


def _source(component: str, spec: WorldSpec, folder: Path) -> tuple[int, str, str | None]:
    """Where a component is read: its index in a channel, and the channel that is subtracted if it is a difference."""
    name, _, label = component.partition(".")
    first, *others = operands(name)
    if any(label not in spec.labels.get(part, ()) for part in (first, *others)):
        raise PolicyError(f"{folder} needs the observation {component!r}, which {spec.task} with {spec.robot} lacks")
    return spec.labels[first].index(label), first, others[0] if others else None


def _number(seen: Observation, at: int, first: str, second: str | None) -> float:
    return seen[first][at] if second is None else seen[first][at] - seen[second][at]
