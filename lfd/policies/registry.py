"""Policies that `lfd train` can make, by the `type` in a recipe's `[policy]` table."""

from dataclasses import dataclass
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature

from lfd.core.channels import ENVIRONMENT_STATE
from lfd.core.errors import RecipeError, UnknownName
from lfd.core.recipe import build
from lfd.data.frames import Frames
from lfd.policies.configuration_bc_mlp import BcMlpConfig
from lfd.policies.modeling_bc_mlp import BcMlpPolicy
from lfd.policies.processor_bc_mlp import make_bc_mlp_pre_post_processors


@dataclass(frozen=True, kw_only=True)
class BcMlpRecipe:
    """The `[policy]` table of type `bc_mlp`."""

    type: str
    """bc_mlp."""
    hidden_sizes: tuple[int, ...]
    """Units of each hidden layer."""

    def check(self, where: str) -> None:
        if min(self.hidden_sizes, default=1) < 1:
            raise RecipeError(f"{where} hidden_sizes = {list(self.hidden_sizes)}: every layer needs at least one unit")


POLICIES = {
    "bc_mlp": (BcMlpRecipe, BcMlpConfig, BcMlpPolicy, make_bc_mlp_pre_post_processors),
}
"""Type to (recipe, LeRobot's config, policy, maker of the processors)."""


def recipe_class(table: dict[str, Any], where: str) -> type[BcMlpRecipe]:
    """The dataclass of a `[policy]` table, by its `type`.

    Raises `UnknownName` for a type that does not exist.
    """
    kind = table.get("type", "")
    if kind not in POLICIES:
        raise UnknownName(f"policy type in {where}:", str(kind), POLICIES)
    return POLICIES[kind][0]


def make_policy(table: dict[str, Any], frames: Frames, device: str, where: str) -> tuple[Any, Any, Any]:
    """An untrained policy for a dataset, and its pre- and post-processor.

    Raises `UnknownName` for a type that does not exist, `RecipeError` for keys that do not fit it.
    """
    recipe = build(recipe_class(table, where), table, where)
    _, config_class, policy_class, make_processors = POLICIES[recipe.type]
    shapes = {name: tuple(rows.shape[1:]) for name, rows in frames.columns.items()}
    inputs = {name: shape for name, shape in shapes.items() if name != "action"}
    config = config_class(
        hidden_sizes=list(recipe.hidden_sizes),
        device=device,
        input_features={
            name: PolicyFeature(FeatureType.ENV if name == ENVIRONMENT_STATE else FeatureType.STATE, shape)
            for name, shape in inputs.items()
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, shapes["action"])},
    )
    return policy_class(config).to(device), *make_processors(config, frames.stats)
