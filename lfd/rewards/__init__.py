"""Features of trajectories and rewards that are linear in them: R(x, u) = w^T phi(x, u)."""

from lfd.rewards.arm_features import ARM_FEATURES, ArmFeature, Places, Spot, arm_features, decision_rows, table_force
from lfd.rewards.feature_counts import FeatureExpectations, feature_counts, feature_expectations

__all__ = [
    "ARM_FEATURES",
    "ArmFeature",
    "FeatureExpectations",
    "Places",
    "Spot",
    "arm_features",
    "decision_rows",
    "feature_counts",
    "feature_expectations",
    "table_force",
]
