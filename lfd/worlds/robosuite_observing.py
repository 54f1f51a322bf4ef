"""What robosuite's own observables say of recorded states, by robosuite's names, as its users know them."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.worlds.environments import make_environment
from lfd.worlds.robots import load_robot
from lfd.worlds.tasks import load_task


def robosuite_observations(
    *, task: str, robot: str, controller: str, control_hz: int, model_xml: str, states: Float[np.ndarray, "T1 _"]
) -> Mapping[str, Float[np.ndarray, "T1 _"]]:
    """The observables in each state (time, qpos, qvel), quaternions in robosuite's order x y z w.

    They belong to the state itself; in a running environment robosuite's lag by one physics step.
    """
    env = _environment(task, robot, controller, control_hz)
    env.reset_from_xml_string(model_xml)
    rows = []
    for state in states:
        env.sim.set_state_from_flattened(state)
        env.sim.forward()
        seen = env._get_observations(force_update=True)
        rows.append({name: np.ravel(value).astype(np.float64) for name, value in seen.items()})
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@lru_cache(maxsize=1)
def _environment(task: str, robot: str, controller: str, control_hz: int) -> Any:
    """One environment for all the episodes of a run."""
    env = make_environment(load_task(task), replace(load_robot(robot), controller=controller), control_hz)
    for name in env.observation_names:  # as robomimic does
        if "joint_pos" in name or "eef_vel" in name:
            env.modify_observable(observable_name=name, attribute="active", modifier=True)
    return env
