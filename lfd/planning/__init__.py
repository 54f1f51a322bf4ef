"""Behaviour from a reward: finite MDPs and their exact solutions, motions of arms.

What moves arms is imported when it is first used: it loads MuJoCo and numba.
"""

from importlib import import_module
from typing import Any

from lfd.planning.deform import deform
from lfd.planning.demonstrations import demonstrated_features, expectation_of_demonstrations, log_likelihood
from lfd.planning.grid_worlds import GridWorld, grid_world, objectworld
from lfd.planning.highway import highway
from lfd.planning.tabular_mdp import Solution, StatesAndActions, TabularMDP

_OF_ARMS = {
    "Arm": "kinematics",
    "ArmPlanner": "arm_planner",
    "Plan": "arm_planner",
    "Scene": "scenes",
    "cup_scene": "scenes",
    "load_arm": "arm_model",
}

__all__ = [
    "Arm",  # pyright: ignore[reportUnsupportedDunderAll]
    "ArmPlanner",  # pyright: ignore[reportUnsupportedDunderAll]
    "GridWorld",
    "Plan",  # pyright: ignore[reportUnsupportedDunderAll]
    "Scene",  # pyright: ignore[reportUnsupportedDunderAll]
    "Solution",
    "StatesAndActions",
    "TabularMDP",
    "cup_scene",  # pyright: ignore[reportUnsupportedDunderAll]
    "deform",
    "demonstrated_features",
    "expectation_of_demonstrations",
    "grid_world",
    "highway",
    "load_arm",  # pyright: ignore[reportUnsupportedDunderAll]
    "log_likelihood",
    "objectworld",
]


def __getattr__(name: str) -> Any:
    if name not in _OF_ARMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(f"lfd.planning.{_OF_ARMS[name]}"), name)
