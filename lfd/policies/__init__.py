"""Learned policies, in LeRobot's form.

Importing this package registers their configurations with LeRobot, so that its own `from_pretrained`
and `--policy.type` know them.
"""

from lfd.policies.configuration_bc_mlp import BcMlpConfig
from lfd.policies.configuration_bc_rnn import BcRnnConfig

__all__ = ["BcMlpConfig", "BcRnnConfig"]
