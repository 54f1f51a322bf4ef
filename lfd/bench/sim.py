"""`lfd bench sim`: a control step of robosuite, ours, and what the physics alone would allow.

All sides take the same actions from the same starts, a few control steps in turn, and CPU time is counted, so
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
from lfd.experts.registry import EXPERTS, make_expert
from lfd.worlds.environments import make_environment
from lfd.worlds.robosuite_world import INTEGRATION, RobosuiteWorld, make_world
from lfd.worlds.robots import load_robot, robot_names
from lfd.worlds.rollout import episode_rng
from lfd.worlds.tasks import TASKS, load_task

TURN = 10
"""Control steps for which one side runs before the next one does."""


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
    """Compare the sides over `episodes` episodes of two seconds.

    The scripted expert acts where there is one, else random actions are taken. Raises `UnknownName` for a task or
    robot that lfd does not know.
    """
    world = make_world(task, robot, control_hz)
    as_shipped = load_task(task), load_robot(robot), control_hz
    stock = {
        "robosuite": make_environment(*as_shipped),
        "robosuite, lite_physics off": make_environment(*as_shipped, lite_physics=False),
    }
    costs, resets = _Costs(), _Costs()
    with progress(f"bench sim {task} {robot}", episodes) as bar:
        for episode in range(episodes):
            _take_episode(world, stock, costs, episode_rng("eval", seed, episode))
            _take_resets(world, stock["robosuite"], resets, seed)
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
            "physics_limit_vs_robosuite": round(rates["physics alone"] / rates["robosuite"], 2),
            "two_threads_vs_one": round(speedup, 2),
            "reset_vs_robosuite": round(resets.rate("ours") / resets.rate("robosuite"), 1),
        },
    )


def bench_everywhere(*, control_hz: int, seed: int, progress: Progress = silent) -> dict[str, dict[str, float]]:
    """The ratios of one core on every task with a Panda, and of every robot on Lift, over two seconds each."""
    pairs = dict.fromkeys([(task, "panda") for task in TASKS] + [("Lift", robot) for robot in robot_names()])
    found = {}
    with progress("every task, every robot", len(pairs)) as bar:
        for task, robot in pairs:
            world, costs = make_world(task, robot, control_hz), _Costs()
            stock = {"robosuite": make_environment(load_task(task), load_robot(robot), control_hz)}
            _take_episode(world, stock, costs, episode_rng("eval", seed, 0))
            ours, theirs, limit = (costs.rate(n) for n in ("ours, one core", "robosuite", "physics alone"))
            found[f"{task} {robot}"] = {
                "one_core_vs_robosuite": round(ours / theirs, 2),
                "one_core_vs_physics_limit": round(ours / limit, 3),
                "physics_limit_vs_robosuite": round(limit / theirs, 2),
            }
            bar.advance(note=f"{task} {robot}: {ours / theirs:.1f}x")
    return found


def _take_episode(world: RobosuiteWorld, stock: dict[str, Any], costs: "_Costs", rng: np.random.Generator) -> None:
    """Two seconds on every side, from the same start with the same actions, in turns of a few steps."""
    spec = world.spec
    expert = make_expert(spec) if spec.task in EXPERTS and spec.robot == "panda" else None
    seen, start = world.reset(rng), world.get_state()
    if expert:
        expert.reset(rng)
    for env in stock.values():
        env.reset_from_xml_string(start.model_xml)
        _put(env.sim.model._model, env.sim.data._data, start.sim)
    bare, substeps = mujoco.MjData(world._model), round(1 / spec.control_hz / world._model.opt.timestep)
    for _ in range(2 * spec.control_hz // TURN):
        actions = []
        for _ in range(TURN):
            action = expert.act(seen).action if expert else rng.uniform(-0.5, 0.5, len(spec.action_low))
            actions.append(action)
            state = world.sim_state()
            seen = costs.take("ours, one core", lambda action=action: world.step(action)).observation
            mujoco.mj_setState(world._model, bare, state, INTEGRATION)
            bare.ctrl[:] = world._data.ctrl
            costs.take("physics alone", lambda: mujoco.mj_step(world._model, bare, substeps))
        for name, env in stock.items():
            for action in actions:
                costs.take(name, lambda env=env, action=action: env.step(action))


def _take_resets(world: RobosuiteWorld, env: Any, costs: "_Costs", seed: int) -> None:
    """Resets one after the other, as in use; a model loaded in between would leave the memory cold."""
    for reset in range(5):
        costs.take("ours", lambda reset=reset: world.reset(episode_rng("eval", seed, reset)))
    costs.take("robosuite", env.reset)


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
