"""Behaviour cloning as a LeRobot policy: what `bc_mlp` and `bc_rnn` share.

    pi_hat = argmin_pi  sum_xi sum_{x in xi}  L(pi(x), pi*(x))

over the states x of the demonstrations xi and the expert's actions pi*(x) in them (chapter 10.2). A network gives
raw numbers, a head (`lfd.policies.heads`) makes an action or a distribution of them and measures L. The network sees
the last n observations; at one or each of them (positions P) it predicts the next C actions (a chunk).
"""

from abc import abstractmethod
from collections import deque
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Bool, Float
from lerobot.configs.types import FeatureType
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from lfd.policies.cloning_config import CloningConfig
from lfd.policies.heads import make_head
from lfd.policies.image_encoder import ImageEncoder

Batch = dict[str, Any]


class CloningPolicy(PreTrainedPolicy):
    """Everything of a cloned policy but the network between the embedded observations and the head."""

    config_class = CloningConfig  # type: ignore[assignment]
    name = "cloning"  # type: ignore[assignment]
    config: CloningConfig

    def __init__(self, config: CloningConfig, **kwargs: Any):
        super().__init__(config)
        config.validate_features()
        assert config.input_features
        assert config.action_feature
        by_kind = sorted(config.input_features.items())
        self.inputs = [key for key, feature in by_kind if feature.type is not FeatureType.VISUAL]
        self.cameras = [key for key, feature in by_kind if feature.type is FeatureType.VISUAL]
        self.action_dim = config.action_feature.shape[0]
        self.head = make_head(config.head_settings(self.action_dim))
        shapes = {key: feature.shape for key, feature in by_kind}
        look = (config.image_channels, config.image_keypoints, config.image_shift)
        eyes = [ImageEncoder(shapes[key], *look) for key in self.cameras]
        self.eyes = nn.ModuleList(eyes)
        self.embedded_size = sum(shapes[key][0] for key in self.inputs) + sum(eye.features for eye in eyes)
        self.raw_size = config.chunk_size * self.head.width
        self.reset()

    @abstractmethod
    def network(self, embedded: Float[Tensor, "B n F"]) -> Float[Tensor, "B P _"]:
        """Raw numbers of a chunk of actions, for the last positions of the window."""
        ...

    @property
    def is_memoryless(self) -> bool:
        """Whether an action depends on the present observation alone."""
        return self.config.n_obs_steps == 1 and self.config.n_action_steps == 1 and not self.config.sample

    def get_optim_params(self) -> Any:
        return self.parameters()

    def raw(self, batch: Batch) -> Float[Tensor, "B P C width"]:
        """What the network says of normalised observations, with or without a time axis."""
        seen = torch.cat([batch[key] for key in self.inputs], dim=-1)
        if seen.ndim == 2:
            seen = seen.unsqueeze(1)
        if self.cameras:
            steps = seen.shape[:2]
            pictures = (batch[key].reshape(-1, *batch[key].shape[-3:]) for key in self.cameras)
            looks = [eye(picture).reshape(*steps, -1) for eye, picture in zip(self.eyes, pictures, strict=True)]
            seen = torch.cat([seen, *looks], dim=-1)
        said = self.network(seen)
        return said.unflatten(-1, (self.config.chunk_size, self.head.width))

    def forward(self, batch: Batch) -> tuple[Float[Tensor, ""], dict[str, float]]:
        """The loss L averaged over the actions of a batch that are there (padding does not count)."""
        raw = self.raw(batch)
        positions, chunk = raw.shape[1:3]
        actions = batch["action"]
        if actions.ndim == 2:
            return self.head.loss(raw[:, 0, 0], actions).mean(), {}
        wanted = actions.unfold(1, chunk, 1).mT  # row j: the actions from position j on
        loss = self.head.loss(raw, wanted[:, -positions:])
        is_there = ~batch["action_is_pad"].unfold(1, chunk, 1)[:, -positions:]
        return _mean_of(loss, is_there), {}

    def reset(self) -> None:
        """Forget the last observations and the planned actions."""
        self._seen: deque[Batch] = deque(maxlen=self.config.n_obs_steps)
        self._planned: deque[Tensor] = deque()

    @torch.no_grad()
    def select_action(self, batch: Batch, **kwargs: Any) -> Float[Tensor, "B Da"]:
        """The action for the next control step."""
        if self.is_memoryless:
            return self.head.mode(self.raw(batch)[:, -1, 0])
        self._remember(batch)
        if not self._planned:
            self._planned.extend(self._chunk().unbind(1)[: self.config.n_action_steps])
        return self._planned.popleft()

    @torch.no_grad()
    def predict_action_chunk(self, batch: Batch, **kwargs: Any) -> Float[Tensor, "B C Da"]:
        """The next actions, given the present observation and those that were remembered."""
        self._remember(batch)
        return self._chunk()

    def _remember(self, batch: Batch) -> None:
        """Take an observation into the window; before the first one stand copies of it, as in the training windows."""
        present = {key: batch[key] for key in (*self.inputs, *self.cameras)}
        self._seen.extend([present] * (1 if self._seen else self.config.n_obs_steps))

    def _chunk(self) -> Float[Tensor, "B C Da"]:
        window = {key: torch.stack([seen[key] for seen in self._seen], dim=1) for key in self._seen[0]}
        raw = self.raw(window)[:, -1]
        return self.head.sample(raw) if self.config.sample else self.head.mode(raw)


def _mean_of(values: Float[Tensor, "*B"], counted: Bool[Tensor, "*B"]) -> Float[Tensor, ""]:
    return (values * counted).sum() / counted.sum().clamp_min(1)


def layers(sizes: list[int], last: int) -> nn.Sequential:
    """x -> W_n relu(... relu(W_1 x + b_1) ...) + b_n."""
    made: list[nn.Module] = []
    for wide, narrow in pairwise(sizes):
        made += [nn.Linear(wide, narrow), nn.ReLU()]
    return nn.Sequential(*made, nn.Linear(sizes[-1], last))
