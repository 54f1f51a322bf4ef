"""The losses of behaviour cloning, by their public names.

They are defined in `lfd/policies/losses.py`, because a LeRobot policy computes its own loss in `forward` and policies
may not import from training; whoever trains looks for them here.
"""

from lfd.policies.losses import (
    f_divergence,
    gaussian_f_divergence,
    huber_loss,
    mixture_log_prob,
    monte_carlo_f_divergence,
    mse,
    p_norm_loss,
)

__all__ = [
    "f_divergence",
    "gaussian_f_divergence",
    "huber_loss",
    "mixture_log_prob",
    "monte_carlo_f_divergence",
    "mse",
    "p_norm_loss",
]
