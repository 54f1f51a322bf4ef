"""Behaviour cloning with a recurrent network (BC-RNN: Mandlekar et al. 2021, arXiv 2108.03298).

An LSTM runs over the last n observations and predicts the action at each of them; only the last prediction is acted
on. Unlike robomimic's, which carries its hidden state for n steps and then forgets all of it, the window moves with
every step, so that the network is always as in training at its last position.
"""

from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from lfd.policies.cloning_policy import CloningPolicy, layers
from lfd.policies.configuration_bc_rnn import BcRnnConfig


class BcRnnPolicy(CloningPolicy):
    """Predicts at every position of the window."""

    config_class = BcRnnConfig
    name = "bc_rnn"

    def __init__(self, config: BcRnnConfig, **kwargs: Any):
        super().__init__(config)
        self.lstm = nn.LSTM(self.embedded_size, config.lstm_units, config.lstm_layers, batch_first=True)
        self.net = layers([config.lstm_units, *config.hidden_sizes], self.raw_size)

    def network(self, embedded: Float[Tensor, "B n F"]) -> Float[Tensor, "B n _"]:
        return self.net(self.lstm(embedded)[0])
