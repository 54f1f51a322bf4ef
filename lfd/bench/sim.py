"""`lfd bench sim`: a control step of robosuite, ours, and what the physics alone would allow.

All sides take the same actions from the same starts, episode by episode in turn, and CPU time is counted, so
that the ratios hold on a machine that is busy or changes its clock. A rate is that of the median step. The
physics alone is mj_step from the states that our steps began in.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from lfd.core.protocols import Progress, silent
from lfd.experts.registry import make_expert
from lfd.worlds.environments import make_environment
from lfd.worlds.robosuite_world import INTEGRATION, RobosuiteWorld, make_world
from lfd.worlds.robots import load_robot
from lfd.worlds.rollout import episode_rng
from lfd.worlds.tasks import load_task


@dataclass(frozen=True, kw_only=True)
class SimBench:
    """What one run measured."""

    task: str
    robot: str
    stepper: str
    control_steps: int
    """Control steps that were timed on every side."""
    steps_per_second: dict[str, float]
    """Side to control steps a second of CPU time, of the median step."""
    reset_seconds: dict[str, float]
    """Side to the CPU time of the median reset [s]."""
    ratios: dict[str, float]


def bench_sim(
    *, task: str, robot: str, control_hz: int, episodes: int, seed: int, progress: Progress = silent
) -> SimBench:
    """Compare the sides over `episodes` episodes of the scripted expert.

    Raises `UnknownName` for a task or robot that lfd does not know.
    """
    world = make_world(task, robot, control_hz)
    stock = {
        "robosuite": make_environment(load_task(task), load_robot(robot), control_hz),
        "robosuite, lite_physics off": make_environment(
            load_task(task), load_robot(robot), control_hz, lite_physics=False
        ),
    }
    expert, costs, resets = make_expert(world.spec), _Costs(), _Costs()
    substeps = round(1 / control_hz / world._model.opt.timestep)
    with progress("bench sim", episodes) as bar:
        for episode in range(episodes):
            rng = episode_rng("eval", seed, episode)
            seen = resets.take("ours", lambda rng=rng: world.reset(rng))
            begin, actions, states, controls = world.get_state(), [], [], []
            for _ in range(2 * control_hz):
                actions.append(expert.act(seen).action)
                states.append(world.sim_state())
                seen = costs.take("ours, one core", lambda action=actions[-1]: world.step(action)).observation
                controls.append(world._data.ctrl.copy())
            for name, env in stock.items():
                env.reset_from_xml_string(begin.model_xml)
                _put(env.sim.model._model, env.sim.data._data, begin.sim)
                for action in actions:
                    costs.take(name, lambda env=env, action=action: env.step(action))
            bare = mujoco.MjData(world._model)
            for state, control in zip(states, controls, strict=True):
                mujoco.mj_setState(world._model, bare, state, INTEGRATION)
                bare.ctrl[:] = control
                costs.take("physics alone", lambda bare=bare: mujoco.mj_step(world._model, bare, substeps))
            resets.take("robosuite", stock["robosuite"].reset)
            bar.advance(note=f"{costs.rate('ours, one core'):.0f} steps/s")
    rates = {name: costs.rate(name) for name in (*stock, "ours, one core", "physics alone")}
    speedup = _threads_against_one(world, make_world(task, robot, control_hz), steps=control_hz * 10)
    rates["ours, two threads"] = rates["ours, one core"] * speedup
    ours = rates["ours, one core"]
    return SimBench(
        task=task,
        robot=robot,
        stepper=world.step_backend,
        control_steps=episodes * 2 * control_hz,
        steps_per_second={name: round(rate, 1) for name, rate in rates.items()},
        reset_seconds={name: round(1 / resets.rate(name), 5) for name in ("robosuite", "ours")},
        ratios={
            "one_core_vs_robosuite": round(ours / rates["robosuite"], 2),
            "one_core_vs_robosuite_lite_physics_off": round(ours / rates["robosuite, lite_physics off"], 2),
            "one_core_vs_physics_limit": round(ours / rates["physics alone"], 3),
            "two_threads_vs_one": round(speedup, 2),
            "reset_vs_robosuite": round(resets.rate("ours") / resets.rate("robosuite"), 1),
        },
    )


class _Costs:
    """CPU seconds of every call, by name."""

    def __init__(self) -> None:
        self._seconds: dict[str, list[float]] = {}

    def take(self, name: str, call: Callable[[], Any]) -> Any:
        began = time.thread_time()
        result = call()
        self._seconds.setdefault(name, []).append(time.thread_time() - began)
        return result

    def rate(self, name: str) -> float:
        return 1 / float(np.median(self._seconds[name]))


def _put(model: Any, data: Any, state: np.ndarray) -> None:
    mujoco.mj_setState(model, data, state, INTEGRATION)
    mujoco.mj_forward(model, data)


def _threads_against_one(first: RobosuiteWorld, second: RobosuiteWorld, *, steps: int) -> float:
    """Control steps a second of two worlds in two threads, as a multiple of one world's (wall time, best of five)."""
    still = np.zeros(len(first.spec.action_low))

    def run(world: RobosuiteWorld) -> None:
        for _ in range(steps):
            world.step(still)

    def seconds(worlds: list[RobosuiteWorld]) -> float:
        threads = [threading.Thread(target=run, args=(world,)) for world in worlds]
        began = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return time.perf_counter() - began

    for world in (first, second):
        world.reset(np.random.default_rng(0))
    pairs = [(seconds([first]), seconds([first, second])) for _ in range(5)]
    return 2 * min(one for one, _ in pairs) / min(two for _, two in pairs)
