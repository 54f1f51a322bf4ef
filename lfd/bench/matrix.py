"""Same numbers: the compiled step against robosuite's own, for robots x controllers x tasks."""

import gc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lfd.core.protocols import Progress, silent
from lfd.experts.noise import NoisyPolicy
from lfd.experts.registry import make_expert
from lfd.run.wilson import wilson_interval
from lfd.worlds.robosuite_world import make_world
from lfd.worlds.robots import CONTROLLERS, robot_names
from lfd.worlds.rollout import episode_rng, rollout
from lfd.worlds.same_numbers import TOLERANCE, Comparison, compare
from lfd.worlds.tasks import TASKS

Case = tuple[str, str, str]
"""Task, robot config and controller."""


@dataclass(frozen=True)
class Row:
    """One case, compared."""

    case: Case
    found: Comparison


@dataclass(frozen=True, kw_only=True)
class Matrix:
    """What a run over many cases found."""

    cases: int
    control_steps: int
    """Control steps compared in each case."""
    within_tolerance: int
    """Cases that differ from robosuite by at most 1e-9."""
    within_robosuites_own: int
    """Further cases that differ from robosuite no more than robosuite does from itself."""
    beyond: list[str]
    """Cases that differ more than that."""


def whole_matrix() -> list[Case]:
    """Every robot with every controller on every task."""
    return [(task, robot, controller) for task in TASKS for robot in robot_names() for controller in CONTROLLERS]


def quick_matrix() -> list[Case]:
    """Cases in which every two of task, robot and controller meet."""
    controllers = list(CONTROLLERS)
    return [
        (task, robot, controllers[(i + j) % len(controllers)])
        for i, task in enumerate(TASKS)
        for j, robot in enumerate(robot_names())
    ]


def compare_cases(cases: Sequence[Case], *, control_hz: int, steps: int, seed: int) -> Iterator[Row]:
    """Compare each case over `steps` control steps of random actions from a start state drawn with `seed`."""
    for task, robot, controller in cases:
        world = make_world(task, robot, control_hz, "compiled", controller=controller)
        rng = np.random.default_rng(seed)
        world.reset(rng)
        actions = rng.uniform(
            1.2 * world.spec.action_low, 1.2 * world.spec.action_high, (steps, len(world.spec.action_low))
        )
        yield Row((task, robot, controller), compare(world, list(actions)))
        del world
        gc.collect()  # a world is a ring of references to much memory that Python does not count


def bench_matrix(
    cases: Sequence[Case], *, control_hz: int, steps: int, seed: int, progress: Progress = silent
) -> Matrix:
    """Compare all cases and count them."""
    rows: list[Row] = []
    with progress("same numbers", len(cases)) as bar:
        for row in compare_cases(cases, control_hz=control_hz, steps=steps, seed=seed):
            rows.append(row)
            bar.advance(note=" ".join(row.case))
    exact = [row for row in rows if row.found.ours <= TOLERANCE]
    beyond = [
        f"{' '.join(row.case)}: {row.found.ours:.1e}, robosuite itself {row.found.itself:.1e}"
        for row in rows
        if not row.found.is_same
    ]
    return Matrix(
        cases=len(rows),
        control_steps=steps,
        within_tolerance=len(exact),
        within_robosuites_own=len(rows) - len(exact) - len(beyond),
        beyond=beyond,
    )


def success_rates(
    *, task: str, robot: str, control_hz: int, episodes: int, seed: int, progress: Progress = silent
) -> dict[str, tuple[int, tuple[float, float]]]:
    """Successes, and the 95% Wilson interval of their rate, of one policy from the same starts on both steppers.

    The policy is the scripted expert with so much noise on its actions, and so little time, that it often fails:
    chaos makes single episodes end differently, their rates must not.
    """
    found = {}
    with progress("success on both steppers", 2 * episodes) as bar:
        for stepper in ("compiled", "robosuite"):
            world = make_world(task, robot, control_hz, stepper)
            policy, successes = NoisyPolicy(make_expert(world.spec), world.spec.labels["action"], scale=0.3), 0
            for episode in range(episodes):
                rng = episode_rng("eval", seed, episode)
                outcome = rollout(world, policy, [], rng, horizon=round(2.5 * control_hz), hold_steps=control_hz // 4)
                successes += outcome.success
                bar.advance(note=f"{stepper}: {successes} of {episode + 1}")
            found[stepper] = successes, wilson_interval(successes, episodes)
    return found
