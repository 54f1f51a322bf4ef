"""Features of trajectories and rewards that are linear in them: R(x, u) = w^T phi(x, u)."""

from lfd.rewards.arm_features import ARM_FEATURES, ArmFeature, Places, Spot, arm_features, decision_rows, table_force
from lfd.rewards.feature_counts import FeatureExpectations, feature_counts, feature_expectations
from lfd.rewards.monte_carlo import expectations_in_worlds, sampled_expectations

__all__ = [
    "ARM_FEATURES",
    "ArmFeature",
    "FeatureExpectations",
    "Places",
    "Spot",
    "arm_features",
    "decision_rows",
    "expectations_in_worlds",
    "feature_counts",
    "feature_expectations",
    "sampled_expectations",
    "table_force",
]
