"""How often the scripted experts succeed, measured: task by task, robot by robot."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

from lfd.core.protocols import Progress, silent
from lfd.experts.registry import check_expert, make_expert
from lfd.experts.style import PLAIN, ExpertStyle
from lfd.run.wilson import wilson_interval
from lfd.worlds.robosuite_world import EVERY_CORE, make_worlds
from lfd.worlds.robots import load_robot
from lfd.worlds.rollout import OneEach, Start, episode_rng, rollouts

STAGE = "eval"


@dataclass(frozen=True)
class Success:
    """An expert's successes with a robot."""

    successes: int
    episodes: int
    mean_seconds: float
    """Mean length of an episode, failures included [s of simulated time]."""

    @property
    def interval(self) -> tuple[float, float]:
        """95% Wilson interval of the success rate."""
        return wilson_interval(self.successes, self.episodes)

    def __str__(self) -> str:
        low, high = self.interval
        rate = f"{self.successes / self.episodes:.1%} of {self.episodes}"
        return f"{rate} ({low:.0%} to {high:.0%}), {self.mean_seconds:.1f} s"


@dataclass(frozen=True, kw_only=True)
class ExpertTrial:
    """How experts are tried."""

    episodes: int
    """Start states for each task and robot."""
    seed: int
    """Seed of the start states."""
    control_hz: int
    """Control steps a second [Hz]."""
    max_seconds: float
    """Simulated time after which an episode has failed [s]."""
    hold_seconds: float
    """Simulated time for which the task must stay solved [s]."""
    style: ExpertStyle = PLAIN
    most_worlds: int = EVERY_CORE
    """Worlds that run in parallel, at the most."""

    def run(self, task: str, robot: str, advance: Callable[[], None]) -> Success:
        """Success of the expert of a task with a robot; `advance` is called after each episode."""
        worlds = make_worlds(task, robot, self.control_hz, most=min(self.most_worlds, self.episodes))
        experts = OneEach([make_expert(world.spec, self.style) for world in worlds])
        starts = (Start(index=i, rng=episode_rng(STAGE, self.seed, i)) for i in range(self.episodes))
        horizon, hold = round(self.max_seconds * self.control_hz), max(1, round(self.hold_seconds * self.control_hz))
        outcomes = []
        for _, outcome in rollouts(worlds, experts, lambda: next(starts, None), horizon=horizon, hold_steps=hold):
            outcomes.append(outcome)
            advance()
        steps = sum(outcome.steps for outcome in outcomes)
        solved = sum(outcome.success for outcome in outcomes)
        return Success(solved, self.episodes, steps / self.episodes / self.control_hz)


def expert_success(
    tasks: Sequence[str], robots: Sequence[str], trial: ExpertTrial, progress: Progress = silent
) -> dict[str, dict[str, Success]]:
    """Success of the expert of each task with each robot.

    Raises `UnknownName` for a task that has no expert, or a robot that has no config.
    """
    for task in tasks:
        check_expert(task)
    for robot in robots:
        load_robot(robot)
    found: dict[str, dict[str, Success]] = {task: {} for task in tasks}
    with progress("experts", len(tasks) * len(robots) * trial.episodes) as bar:
        for task, robot in product(tasks, robots):
            found[task][robot] = trial.run(task, robot, lambda said=f"{task} {robot}": bar.advance(note=said))
    return found
