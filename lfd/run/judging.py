"""Judging a policy while it is trained, by rollouts: the validation loss does not tell which weights act best.

Mandlekar et al. 2021 (arXiv 2108.03298) find the checkpoint with the lowest validation loss far below the one that
acts best. Judgements have start states of their own: those of evaluations stay unseen.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from lfd.core.protocols import silent
from lfd.run.trial import EvalRecipe, Trial
from lfd.worlds.robosuite_world import EVERY_CORE, RobosuiteWorld, make_worlds

STAGE = "judge"


def rollout_judge(recipe: EvalRecipe, episodes: int, *, most_worlds: int = EVERY_CORE) -> Callable[[Path], float]:
    """A function from a policy folder to its success rate over `episodes` start states, always the same ones.

    Its worlds are built at the first call and kept.
    """
    recipe, worlds = replace(recipe, episodes=episodes), list[RobosuiteWorld]()

    def judge(policy: Path) -> float:
        trial = Trial.of(policy, recipe)
        if not worlds:
            about, most = trial.about, min(most_worlds, episodes)
            worlds.extend(make_worlds(about["task"], trial.robot, about["control_hz"], most=most, progress=silent))
        return sum(outcome.success for _, outcome in trial.run(worlds, STAGE, range(episodes))) / episodes

    return judge
