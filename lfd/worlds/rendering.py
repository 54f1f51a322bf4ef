"""Ways to draw without a screen, and what they need of the machine; free of heavy imports."""

import ctypes.util
import os
from collections.abc import Iterable

from lfd.core.errors import SimulationError

BACKENDS = {"egl": ("EGL", "libegl1 libgl1"), "osmesa": ("OSMesa", "libosmesa6")}
"""The best first, each with its library and the Debian packages that bring it."""
OFF = ("disable", "disabled", "off", "false", "0")
"""Values of MUJOCO_GL that turn rendering off."""


def wished() -> str:
    """What the environment variable MUJOCO_GL asks for."""
    return os.environ.get("MUJOCO_GL", "").strip().lower()


def advice(backends: Iterable[str]) -> str:
    """What to type to get one of some backends."""
    packages = " or ".join(f"`apt install {BACKENDS[name][1]}` ({name})" for name in backends)
    return f"On Debian or Ubuntu: {packages}. `lfd doctor` shows what works."


def check_wish() -> None:
    """Raise `SimulationError` when MUJOCO_GL asks for what is not installed: `import mujoco` itself would crash."""
    wish = wished()
    if wish in BACKENDS and not ctypes.util.find_library(BACKENDS[wish][0]):
        raise SimulationError(f"MUJOCO_GL={wish}, but {BACKENDS[wish][0]} is not installed. {advice([wish])}")
