"""What the configurations of `bc_mlp` and `bc_rnn` share; LeRobot's own names where it has them."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim import AdamWConfig

from lfd.policies.heads import HeadSettings


@dataclass
class CloningConfig(PreTrainedConfig):
    """Behaviour cloning: from the last observations to the next actions."""

    n_obs_steps: int = 1
    """Observations that the policy sees: the present one and those before it."""
    chunk_size: int = 1
    """Actions that are predicted at a time."""
    n_action_steps: int = 1
    """Actions of a prediction that are executed before the next one is made."""
    hidden_sizes: list[int] = field(default_factory=lambda: [256, 256])
    """Units of each hidden layer."""
    head: str = "point"
    """What is predicted: point (the action), gaussian, mixture (of Gaussians) or discrete (bins)."""
    loss: str = "mse"
    """L(pi(x), pi*(x)): mse, p_norm or huber for a point; nll, kl, reverse_kl, js, tv, chi2, hellinger2 otherwise."""
    p: float = 2.0
    """Which norm p_norm is; inf is the largest component."""
    huber_delta: float = 0.1
    """Deviation at which huber goes from the square to the absolute value [action]."""
    components: int = 5
    """Gaussians of a mixture."""
    bins: int = 51
    """Bins of each component of a discrete action, over [-1, 1]."""
    expert_std: float = 0.05
    """Standard deviation of the Gaussian around its label that stands for the expert in a divergence [action]."""
    loss_samples: int = 64
    """Samples of a divergence that has no closed form."""
    min_std: float = 0.01
    """Smallest standard deviation of a Gaussian [action]."""
    sample: bool = False
    """Act by a draw from the predicted distribution instead of its mode."""
    image_channels: list[int] = field(default_factory=lambda: [32, 64, 64])
    """Channels of the convolutions that see a picture."""
    image_keypoints: int = 32
    """Image points that a picture is reduced to (spatial softmax)."""
    image_shift: int = 4
    """Pixels by which pictures are shifted at random in training."""
    push_to_hub: bool = False  # LeRobot's default uploads
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "VISUAL": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.IDENTITY,  # robosuite's controllers take [-1, 1]
        }
    )
    learning_rate: float = 1e-3
    """Step size of `lerobot-train`; `lfd train` takes it from its recipe."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("n_obs_steps", "chunk_size", "n_action_steps", "image_keypoints"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key} = {getattr(self, key)}: must be at least 1")
        if self.n_action_steps > self.chunk_size:
            raise ValueError(
                f"n_action_steps = {self.n_action_steps} of a chunk of {self.chunk_size}: give at most that"
            )
        if min(self.hidden_sizes, default=1) < 1:
            raise ValueError(f"hidden_sizes = {self.hidden_sizes}: every layer needs at least one unit")
        self.head_settings(1).check(self.type)

    def head_settings(self, action_dim: int) -> HeadSettings:
        """What the action head is made of."""
        same = ("head", "loss", "p", "huber_delta", "components", "bins", "expert_std", "loss_samples", "min_std")
        return HeadSettings(action_dim=action_dim, **{key: getattr(self, key) for key in same})

    @property
    def observation_delta_indices(self) -> list[int] | None:
        return None if self.n_obs_steps == 1 else list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int] | None:
        return None if self.chunk_size == 1 else list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate)

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        """Raise `ValueError` for features that the policy cannot use."""
        if self.robot_state_feature is None or self.action_feature is None:
            raise ValueError(f"{self.type} needs the features observation.state and action")
