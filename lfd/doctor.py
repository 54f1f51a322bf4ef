"""What of this machine works: Python, libraries, rendering, devices, GPU."""

import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from packaging.requirements import Requirement

RENDER = "import mujoco; mujoco.GLContext(64, 64).make_current(); print('ok')"
STEP = """
import numpy as np
from lfd.worlds.robosuite_world import make_world
world = make_world("Lift", "panda", 20)
world.reset(np.random.default_rng(0))
world.step(np.zeros(7))
print("ok")
"""


@dataclass(frozen=True)
class Check:
    """One thing looked at."""

    name: str
    works: bool
    needed: bool
    """Whether lfd cannot do without."""
    detail: str
    """What was found, and what to do when it does not work."""


def examine() -> list[Check]:
    """Look at everything; takes some seconds, because a simulation and two renderers are really started."""
    checks = [Check("python", sys.version_info >= (3, 12), True, f"{platform.python_version()} at {sys.executable}")]
    checks += [_library(Requirement(text)) for text in requires("lfd") or [] if "extra ==" not in text]
    checks.append(_runs("simulation", STEP, {}, True, "robosuite's Lift steps"))
    for backend, package in (("egl", "libegl1 libgl1"), ("osmesa", "libosmesa6")):
        hint = f"offscreen rendering with MUJOCO_GL={backend}; on Debian: apt install {package}"
        checks.append(_runs(f"rendering {backend}", RENDER, {"MUJOCO_GL": backend}, False, hint))
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    checks.append(Check("screen", bool(screen), False, screen or "none; use `lfd replay --save FILE.rrd`"))
    devices = [str(p) for p in (*Path("/dev").glob("hidraw*"), *Path("/dev/input").glob("event*"))]
    checks.append(Check("devices", bool(devices), False, ", ".join(sorted(devices)) or "no input devices"))
    checks.append(_gpu())
    return checks


def _library(wanted: Requirement) -> Check:
    try:
        found = version(wanted.name)
    except PackageNotFoundError:
        return Check(wanted.name, False, True, "not installed; run `make demo`, or install requirements.lock")
    fits = wanted.specifier.contains(found, prereleases=True)
    return Check(wanted.name, fits, True, found if fits else f"{found}, lfd needs {wanted.specifier}")


def _runs(name: str, code: str, environment: dict[str, str], needed: bool, detail: str) -> Check:
    """A check in a process of its own: a missing driver may end the process."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    works = done.returncode == 0 and done.stdout.strip().endswith("ok")
    lines = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith(" ")]
    return Check(name, works, needed, detail if works or not lines else f"{detail} ({lines[-1]})")


def _gpu() -> Check:
    import torch

    if torch.cuda.is_available():
        return Check("gpu", True, False, torch.cuda.get_device_name())
    return Check("gpu", False, False, "none; training and rendering use the CPU")
