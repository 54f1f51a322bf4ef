"""Configuration of the `bc_mlp` policy (LeRobot binds configuration_, modeling_ and processor_ by name)."""

from dataclasses import dataclass

from lerobot.configs.policies import PreTrainedConfig

from lfd.policies.cloning_config import CloningConfig


@PreTrainedConfig.register_subclass("bc_mlp")
@dataclass
class BcMlpConfig(CloningConfig):
    """A multilayer perceptron from the last observations to the next actions."""
