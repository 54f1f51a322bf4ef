"""From demonstrations, comparisons and corrections to the weights of R(x, u) = w^T phi(x, u) (chapters 10.4 and 10.5).

The Laplace approximation is imported when it is first used: it alone needs torch.
"""

from importlib import import_module
from typing import Any

from lfd.reward_learning.apprenticeship import Apprenticeship, apprenticeship
from lfd.reward_learning.corrections import correction_update, explained_share, one_feature_update
from lfd.reward_learning.dissimilarity import DISSIMILARITIES, action_losses, unvisited_losses
from lfd.reward_learning.failures import Infeasible, NotConcave, SolverFailed
from lfd.reward_learning.hull import MaxMargin, max_margin
from lfd.reward_learning.identifiable import Identifiable, identifiable_directions, identifiable_from_counts
from lfd.reward_learning.margin_loop import MaxMarginPlanningLoop, loss_augmented_planner, max_margin_planning_loop
from lfd.reward_learning.margin_planning import MaxMarginPlanning, max_margin_planning
from lfd.reward_learning.maxent_sampled import MaxEntSampled, SampledTrajectories, fixed_pool, maxent_sampled
from lfd.reward_learning.maxent_tabular import MaxEnt, maxent_tabular, maxent_tabular_objective
from lfd.reward_learning.preference_posterior import PreferencePosterior
from lfd.reward_learning.queries import Query, best_batch, best_query, query_values, worth_asking
from lfd.reward_learning.weight_belief import WeightBelief, belief_of, undone, updated, weights_about

_WITH_TORCH = ("LaplaceMaxEnt", "laplace_log_likelihood", "maxent_laplace")

__all__ = [
    "DISSIMILARITIES",
    "Apprenticeship",
    "Identifiable",
    "Infeasible",
    "LaplaceMaxEnt",  # pyright: ignore[reportUnsupportedDunderAll]
    "MaxEnt",
    "MaxEntSampled",
    "MaxMargin",
    "MaxMarginPlanning",
    "MaxMarginPlanningLoop",
    "NotConcave",
    "PreferencePosterior",
    "Query",
    "SampledTrajectories",
    "SolverFailed",
    "WeightBelief",
    "action_losses",
    "apprenticeship",
    "belief_of",
    "best_batch",
    "best_query",
    "correction_update",
    "explained_share",
    "fixed_pool",
    "identifiable_directions",
    "identifiable_from_counts",
    "laplace_log_likelihood",  # pyright: ignore[reportUnsupportedDunderAll]
    "loss_augmented_planner",
    "max_margin",
    "max_margin_planning",
    "max_margin_planning_loop",
    "maxent_laplace",  # pyright: ignore[reportUnsupportedDunderAll]
    "maxent_sampled",
    "maxent_tabular",
    "maxent_tabular_objective",
    "one_feature_update",
    "query_values",
    "undone",
    "unvisited_losses",
    "updated",
    "weights_about",
    "worth_asking",
]


def __getattr__(name: str) -> Any:
    if name not in _WITH_TORCH:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module("lfd.reward_learning.laplace"), name)
