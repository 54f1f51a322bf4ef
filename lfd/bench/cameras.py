"""What a picture costs: robosuite's renderer and ours, in one run.

Both draw the same states in turn, frame by frame, so that the ratio holds on a machine that is busy or changes
its clock. A frame is one camera's picture. Rates are those of the median frame, by the clock on the wall and by
CPU time (Mesa draws in threads).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from lfd.core.protocols import Progress, silent
from lfd.worlds.cameras import Cameras
from lfd.worlds.environments import make_environment
from lfd.worlds.robosuite_world import INTEGRATION, make_world
from lfd.worlds.robots import load_robot
from lfd.worlds.rollout import episode_rng
from lfd.worlds.tasks import load_task


@dataclass(frozen=True, kw_only=True)
class CamerasBench:
    """What one run measured."""

    task: str
    robot: str
    cameras: tuple[str, ...]
    frames: int
    """Pictures that each side drew in each size."""
    frames_per_second: dict[str, float]
    """Side and height [pixels] to frames a second on the wall clock."""
    frames_per_cpu_second: dict[str, float]
    """Side and height [pixels] to frames a second of CPU time."""
    mean_difference: float
    """Mean difference of the two sides' pictures [1/255], of the camera and size where it is largest."""
    ratios: dict[str, float]
    """Ours by robosuite's, of the size where the ratio is smallest."""


def bench_cameras(
    *,
    task: str,
    robot: str,
    control_hz: int,
    cameras: Sequence[str],
    sizes: Sequence[int],
    states: int,
    seed: int,
    progress: Progress = silent,
) -> CamerasBench:
    """Draw `states` states along a random motion with square pictures of each of `sizes` [pixels].

    Raises `UnknownName` for a task, robot or camera that does not exist, `SimulationError` when this machine
    cannot draw offscreen.
    """
    world = make_world(task, robot, control_hz)
    rng = episode_rng("eval", seed, 0)
    world.reset(rng)
    begin = world.get_state()
    ours = {size: Cameras(begin.model_xml, cameras, height=size, width=size) for size in sizes}
    stock = make_environment(load_task(task), load_robot(robot), control_hz, has_offscreen_renderer=True)
    stock.reset_from_xml_string(begin.model_xml)
    wall: dict[str, list[float]] = {}
    cpu: dict[str, list[float]] = {}
    apart: dict[tuple[str, int], list[float]] = {}
    for drawer in ours.values():
        drawer.render(begin.sim)  # the first frame compiles shaders
    with progress("bench cameras", states) as bar:
        for _ in range(states):
            world.step(rng.uniform(world.spec.action_low, world.spec.action_high))
            state = world.sim_state()
            _put(stock, state)
            for size, drawer in ours.items():
                theirs = _timed(lambda size=size: _draw(stock, cameras, size), f"robosuite, {size} px", wall, cpu)
                mine = _timed(lambda drawer=drawer: drawer.render(state), f"ours, {size} px", wall, cpu)  # noqa: B023
                for name in cameras:
                    away = np.abs(mine[name] - theirs[name].astype(float)).mean()
                    apart.setdefault((name, size), []).append(float(away))
            bar.advance(note=f"{len(cameras) / wall[f'ours, {sizes[0]} px'][-1]:.0f} frames/s")
    for drawer in ours.values():
        drawer.close()
    stock.close()
    rates, cpu_rates = ({k: len(cameras) / float(np.median(v)) for k, v in costs.items()} for costs in (wall, cpu))
    return CamerasBench(
        task=task,
        robot=robot,
        cameras=tuple(cameras),
        frames=states * len(cameras),
        frames_per_second={side: round(rate, 1) for side, rate in rates.items()},
        frames_per_cpu_second={side: round(rate, 1) for side, rate in cpu_rates.items()},
        mean_difference=round(max(float(np.mean(values)) for values in apart.values()), 3),
        ratios={
            "cameras_vs_robosuite": round(_smallest_ratio(rates, sizes), 2),
            "cameras_vs_robosuite_cpu": round(_smallest_ratio(cpu_rates, sizes), 2),
        },
    )


def _put(env: Any, state: np.ndarray) -> None:
    mujoco.mj_setState(env.sim.model._model, env.sim.data._data, state, INTEGRATION)
    mujoco.mj_forward(env.sim.model._model, env.sim.data._data)


def _draw(env: Any, cameras: Sequence[str], size: int) -> dict[str, np.ndarray]:
    env.sim._render_context_offscreen.gl_ctx.make_current()  # robosuite assumes that nobody else draws
    return {name: env.sim.render(camera_name=name, height=size, width=size)[::-1] for name in cameras}


def _timed(
    call: Callable[[], dict[str, np.ndarray]], side: str, wall: dict[str, list[float]], cpu: dict[str, list[float]]
) -> dict[str, np.ndarray]:
    began, began_cpu = time.perf_counter(), time.process_time()
    pictures = call()
    cpu.setdefault(side, []).append(time.process_time() - began_cpu)
    wall.setdefault(side, []).append(time.perf_counter() - began)
    return pictures


def _smallest_ratio(rates: dict[str, float], sizes: Sequence[int]) -> float:
    return min(rates[f"ours, {size} px"] / rates[f"robosuite, {size} px"] for size in sizes)
