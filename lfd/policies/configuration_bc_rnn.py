"""Configuration of the `bc_rnn` policy (LeRobot binds configuration_, modeling_ and processor_ by name)."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig

from lfd.policies.cloning_config import CloningConfig


@PreTrainedConfig.register_subclass("bc_rnn")
@dataclass
class BcRnnConfig(CloningConfig):
    """A recurrent network (LSTM) over the last observations, which predicts actions at each of them."""

    n_obs_steps: int = 10
    """Observations that the policy sees: the present one and those before it."""
    hidden_sizes: list[int] = field(default_factory=list)
    """Units of the layers between the LSTM and the action."""
    lstm_units: int = 256
    """Units of each layer of the LSTM."""
    lstm_layers: int = 2
    """Layers of the LSTM."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("lstm_units", "lstm_layers"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key} = {getattr(self, key)}: must be at least 1")

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(1 - self.n_obs_steps, self.chunk_size))
