"""`lfd bench interaction`: four robots among random people, and what planning with the implicit gradient spares.

Episode i begins alike for every robot, with the same person. Planning is compared in the situations of one episode: the
same planner with central differences, which needs 2 n best responses more for a gradient of n controls.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lfd.core.processes import ProcessMap, cores, in_order
from lfd.core.protocols import Progress, silent
from lfd.interaction.interactive_robot import KINDS, RobotOptions
from lfd.interaction.scenes import scene_of
from lfd.loops.interacting import InteractRecipe, Trial, label, run_trial

GRADIENTS = {"implicit": 0.0, "differences": 1e-5}
"""How a plan is differentiated, and the step of central differences [m/s^2, rad or m/s]."""
CONTROL_HZ = 5


@dataclass(frozen=True, kw_only=True)
class InteractionBench:
    """What one run measured."""

    scenes: dict[str, dict[str, list[Trial]]]
    """Scene to robot to its trials."""
    planning: dict[str, dict[str, dict[str, float]]]
    """Scene to implicit and differences to processor time of a plan [ms], best responses of it and of a gradient."""


def bench_interaction(
    *, scenes: Sequence[str], episodes: int, seed: int, compared_steps: int, progress: Progress = silent
) -> InteractionBench:
    """Run `episodes` of each scene with each robot, and compare planners over `compared_steps` steps.

    Episodes run on all cores; times of plans are of the processor, so that this does not matter to them.
    """
    recipes = {scene: recipe_of(scene, episodes, seed) for scene in scenes}
    units = [
        (recipe, robot, index) for recipe in recipes.values() for robot in recipe.robots for index in range(episodes)
    ]
    found: dict[str, dict[str, list[Trial]]] = {scene: {} for scene in scenes}
    planning: dict[str, dict[str, dict[str, float]]] = {}
    with progress("bench interaction", len(units) + len(GRADIENTS) * len(scenes)) as bar:
        for scene, recipe in recipes.items():
            planning[scene] = {}
            for name, difference in GRADIENTS.items():
                planning[scene][name] = planning_cost(recipe, difference, compared_steps)
                bar.advance(note=f"{scene}, planning, {name}")
        for (recipe, robot, _), trial in zip(units, in_order(ProcessMap(cores())(_run, None, units)), strict=True):
            found[recipe.scene].setdefault(label(robot), []).append(trial)
            bar.advance(note=f"{recipe.scene}, {label(robot)}: {trial.seconds:.1f} s")
    return InteractionBench(scenes=found, planning=planning)


def _run(_: None, unit: tuple[InteractRecipe, RobotOptions, int]) -> Trial:
    """A worker's part: one episode."""
    return run_trial(*unit)


def recipe_of(scene: str, episodes: int, seed: int) -> InteractRecipe:
    """The people of the benchmark: any type, with the same probability."""
    return InteractRecipe(
        scene=scene,
        robots=scene_of(scene).robots(KINDS),
        person="random",
        episodes=episodes,
        seed=seed,
        control_hz=CONTROL_HZ,
    )


def planning_cost(recipe: InteractRecipe, difference: float, steps: int) -> dict[str, float]:
    """Medians over the first steps of an episode of the robot that infers."""
    (robot,) = scene_of(recipe.scene).robots(("passive",), difference=difference)
    short = replace(recipe, max_seconds=steps / recipe.control_hz)
    trial = run_trial(short, robot, 0)
    return {"ms": trial.plan_ms, "solves": trial.solves, "per_gradient": trial.per_gradient}
