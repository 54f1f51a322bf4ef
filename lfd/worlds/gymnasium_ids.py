"""Names of the worlds in Gymnasium's registry: `lfd/Lift-Panda-v0`, for every task with every robot config.

Importing lfd does not import Gymnasium. The names are registered when both are there: at once, or when
Gymnasium is imported later.
"""

import sys
from importlib.abc import MetaPathFinder
from importlib.util import find_spec
from typing import Any

REGISTRATION = "gymnasium.envs.registration"


def register_when_imported() -> None:
    """Register all names now if Gymnasium is loaded, else as soon as it is."""
    if REGISTRATION in sys.modules:
        _register(sys.modules[REGISTRATION])
    else:
        sys.meta_path.insert(0, _Waiting())


class _Waiting(MetaPathFinder):
    """Waits for Gymnasium's registry to be imported, and steps aside."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        if fullname != REGISTRATION:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        assert spec is not None
        loader: Any = spec.loader
        execute = loader.exec_module

        def execute_and_register(module: Any) -> None:
            execute(module)
            _register(module)

        loader.exec_module = execute_and_register
        return spec


def _register(registration: Any) -> None:
    from lfd.worlds.robots import load_robot, robot_names
    from lfd.worlds.tasks import TASKS

    times = {"control_hz": 20, "max_seconds": 10.0, "hold_seconds": 0.5}
    for robot in robot_names():
        for task in TASKS:
            registration.register(
                id=f"lfd/{task}-{load_robot(robot).robosuite_name}-v0",
                entry_point="lfd.worlds.gymnasium_env:ArmEnv",
                kwargs={"task": task, "robot": robot, **times},
            )
