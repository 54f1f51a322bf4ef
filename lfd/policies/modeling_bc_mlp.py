"""Behaviour cloning with a multilayer perceptron.

    pi_hat = argmin_pi  sum_xi sum_{x in xi}  L(pi(x), pi*(x)),    L(u, u*) = |u - u*|_2^2 / Da

over the states x of the demonstrations xi and the expert's actions pi*(x) in them (chapter 10.2).
"""

from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from lfd.policies.configuration_bc_mlp import BcMlpConfig


class BcMlpPolicy(PreTrainedPolicy):
    """u = W_n relu(... relu(W_1 x + b_1) ...) + b_n on normalised observations."""

    config_class = BcMlpConfig  # type: ignore[assignment]
    name = "bc_mlp"  # type: ignore[assignment]

    def __init__(self, config: BcMlpConfig, **kwargs: Any):
        super().__init__(config)
        config.validate_features()
        assert config.input_features
        assert config.action_feature
        self.inputs = sorted(config.input_features)
        sizes = [sum(config.input_features[key].shape[0] for key in self.inputs), *config.hidden_sizes]
        layers: list[nn.Module] = []
        for wide, narrow in pairwise(sizes):
            layers += [nn.Linear(wide, narrow), nn.ReLU()]
        self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], config.action_feature.shape[0]))

    def get_optim_params(self) -> Any:
        return self.parameters()

    def reset(self) -> None:
        """Nothing to forget: the policy has no memory."""

    def predict(self, batch: dict[str, Any]) -> Float[Tensor, "B Da"]:
        """Actions for normalised observations."""
        return self.net(torch.cat([batch[key] for key in self.inputs], dim=-1))

    def forward(self, batch: dict[str, Any]) -> tuple[Float[Tensor, ""], dict[str, float]]:
        """The loss L averaged over the batch."""
        return nn.functional.mse_loss(self.predict(batch), batch["action"]), {}

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Float[Tensor, "B Da"]:
        """The action for the next control step."""
        return self.predict(batch)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Float[Tensor, "B 1 Da"]:
        """The next action as a chunk of one."""
        return self.predict(batch).unsqueeze(1)
