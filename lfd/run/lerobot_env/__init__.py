"""Worlds of lfd as an environment of LeRobot's, `--env.type=lfd`.

Importing this package registers the environment and the policies of lfd with LeRobot, whose commands do so for
`--env.discover_packages_path=lfd.run.lerobot_env`.
"""

import lfd.policies  # noqa: F401  (registers the policies)
from lfd.run.lerobot_env.config import LfdEnvConfig

__all__ = ["LfdEnvConfig"]
