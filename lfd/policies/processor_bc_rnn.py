"""Pre- and post-processing of the `bc_rnn` policy: batching, normalising, and back."""

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from lfd.policies.configuration_bc_rnn import BcRnnConfig


def make_bc_rnn_pre_post_processors(
    config: BcRnnConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """The pipelines around the policy; `dataset_stats` are those of its training data."""
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
