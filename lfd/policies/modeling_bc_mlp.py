"""Behaviour cloning with a multilayer perceptron.

u = W_n relu(... relu(W_1 x + b_1) ...) + b_n, where x holds the last observations, normalised, one after the other.
"""

from typing import Any

from jaxtyping import Float
from torch import Tensor

from lfd.policies.cloning_policy import CloningPolicy, layers
from lfd.policies.configuration_bc_mlp import BcMlpConfig


class BcMlpPolicy(CloningPolicy):
    """Predicts from the whole window at once, at its last position."""

    config_class = BcMlpConfig
    name = "bc_mlp"

    def __init__(self, config: BcMlpConfig, **kwargs: Any):
        super().__init__(config)
        self.net = layers([config.n_obs_steps * self.embedded_size, *config.hidden_sizes], self.raw_size)

    def network(self, embedded: Float[Tensor, "B n F"]) -> Float[Tensor, "B 1 _"]:
        return self.net(embedded.flatten(1)).unsqueeze(1)
