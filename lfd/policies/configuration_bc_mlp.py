"""Configuration of the `bc_mlp` policy (LeRobot binds configuration_, modeling_ and processor_ by name)."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("bc_mlp")
@dataclass
class BcMlpConfig(PreTrainedConfig):
    """A multilayer perceptron from one observation to one action."""

    hidden_sizes: list[int] = field(default_factory=lambda: [256, 256])
    """Units of each hidden layer."""
    push_to_hub: bool = False  # LeRobot's default uploads
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.IDENTITY,  # robosuite's controllers take [-1, 1]
        }
    )
    learning_rate: float = 1e-3
    """Step size of `lerobot-train`; `lfd train` takes it from its recipe."""

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate)

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        """Raise `ValueError` for features that this policy cannot use."""
        if self.image_features:
            raise ValueError(f"bc_mlp takes no images, got {', '.join(self.image_features)}")
        if self.robot_state_feature is None or self.action_feature is None:
            raise ValueError("bc_mlp needs the features observation.state and action")
