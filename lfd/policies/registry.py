"""Policies that `lfd train` can make, by the `type` in a recipe's `[policy]` table.

The other keys of the table are fields of LeRobot's configuration of that type, ours and theirs alike.
"""

import dataclasses
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature

from lfd.core.channels import ENVIRONMENT_STATE
from lfd.core.errors import RecipeError, UnknownName
from lfd.data.frames import Frames

POLICIES = ("bc_mlp", "bc_rnn", "act", "diffusion")
REGISTER = (
    "lfd.policies",
    "lerobot.policies.act.configuration_act",
    "lerobot.policies.diffusion.configuration_diffusion",
)
"""Modules whose import registers configurations with LeRobot."""
SET_BY_US = ("input_features", "output_features", "device", "push_to_hub")
"""Fields that come from the dataset and from the `[train]` table."""
Table = Mapping[str, Any]


def config_class(kind: str, where: str) -> type:
    """LeRobot's configuration of a policy type.

    Raises `UnknownName` for a type that does not exist.
    """
    from lerobot.configs.policies import PreTrainedConfig

    for module in REGISTER:
        import_module(module)
    if kind not in POLICIES:
        raise UnknownName(f"policy type in {where}:", kind, POLICIES)
    return PreTrainedConfig.get_choice_class(kind)


def make_config(table: Table, where: str, **features: Any) -> Any:
    """The configuration that a `[policy]` table describes.

    Raises `UnknownName` for a type or key that does not exist, `RecipeError` for a value that does not fit.
    """
    import draccus

    kind = config_class(str(table.get("type", "")), where)
    known = {field.name for field in dataclasses.fields(kind)} - set(SET_BY_US)
    for key in table:
        if key not in known | {"type"}:
            raise UnknownName(f"key in {where}:", key, known)
    given = {key: list(value) if isinstance(value, tuple) else value for key, value in table.items() if key != "type"}
    try:
        config = draccus.decode(kind, {"device": "cpu", "push_to_hub": False, **given})
        for name, value in features.items():
            setattr(config, name, value)
        if features:
            config.validate_features()
    except draccus.utils.DecodingError as error:
        raise RecipeError(f"{where} of type {table['type']}: {error}") from error
    except (draccus.utils.ParsingError, ValueError, TypeError) as error:  # the first wraps what a configuration says
        raise RecipeError(f"{where} of type {table['type']}: {error.__cause__ or error}") from error
    return config


def make_policy(table: Table, frames: Frames, device: str, where: str) -> tuple[Any, Any, Any]:
    """An untrained policy for a dataset, and its pre- and post-processor.

    Raises `UnknownName` for a type that does not exist, `RecipeError` for keys that do not fit it or the dataset.
    """
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    shapes = {name: tuple(rows.shape[1:]) for name, rows in frames.columns.items()}
    inputs = {name: shape for name, shape in shapes.items() if name != "action"}
    features = {name: PolicyFeature(_kind(name), shape) for name, shape in inputs.items()}
    features |= {name: PolicyFeature(FeatureType.VISUAL, tuple(p.shape[1:])) for name, p in frames.images.items()}
    config = make_config(
        table,
        where,
        device=device,
        input_features=features,
        output_features={"action": PolicyFeature(FeatureType.ACTION, shapes["action"])},
    )
    before, after = make_pre_post_processors(config, dataset_stats=frames.stats)
    return get_policy_class(config.type)(config).to(device), before, after


def _kind(name: str) -> FeatureType:
    return FeatureType.ENV if name == ENVIRONMENT_STATE else FeatureType.STATE
