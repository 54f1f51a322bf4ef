"""A policy on trial: episodes from start states that no demonstration began at."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfd.core.errors import PolicyError, RecipeError
from lfd.core.protocols import Observer
from lfd.core.recipe import as_table
from lfd.policies.acting import AskedOnce, LearnedPolicy, about_policy, camera_of
from lfd.worlds.robosuite_world import RobosuiteWorld
from lfd.worlds.rollout import Outcome, Start, episode_rng, rollouts


@dataclass(frozen=True, kw_only=True)
class EvalRecipe:
    """The `[eval]` table of a file in `policies/`."""

    episodes: int
    """Start states to try."""
    seed: int
    """Seed of the start states; they differ from those of recordings of the same seed."""
    max_seconds: float
    """Simulated time after which an episode has failed [s]."""
    hold_seconds: float
    """Simulated time for which the task must stay solved [s]."""

    def check(self, where: str) -> None:
        for key in ("episodes", "max_seconds", "hold_seconds"):
            if getattr(self, key) <= 0:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0")
        if self.seed < 0:
            raise RecipeError(f"{where} seed = {self.seed}: must not be negative")


@dataclass(frozen=True)
class Trial:
    """A policy, what it was made for, the robot that it is to move, and how it is tried."""

    policy: Path
    about: Mapping[str, Any]
    """The policy's manifest."""
    recipe: EvalRecipe
    robot: str
    """Robot config."""
    forced: bool = False
    """Whether the policy must act though it was made for another robot."""

    @classmethod
    def of(
        cls,
        policy: Path,
        recipe: EvalRecipe,
        *,
        robot: str | None = None,
        forced: bool = False,
        dataset: Path | None = None,
    ) -> "Trial":
        """The trial of a policy folder, on its own robot unless another is named (and forced on it).

        Raises `PolicyError` for a folder that is no policy, or made for another robot and not forced.
        """
        about = about_policy(policy, dataset)
        if robot not in (None, about["robot"]) and not forced:
            raise PolicyError(
                f"{policy} was trained for robot {about['robot']}, not {robot}; add --force to run it all the same"
            )
        return cls(policy, about, recipe, robot or about["robot"], forced)

    @property
    def used(self) -> dict[str, Any]:
        """The recipe as it is used."""
        return {**self.about["recipe"], "eval": as_table(self.recipe)}

    def learned(self, worlds: Sequence[RobosuiteWorld]) -> LearnedPolicy:
        """The policy, looking through the cameras of the worlds that it is to act in, where it takes pictures."""
        cameras = self.about.get("cameras", {})
        names = tuple(camera_of(feature) for feature in cameras)
        for world in worlds:
            if names and world.spec.cameras != names:
                height, width = next(iter(cameras.values()))
                world.take_cameras(names, height=height, width=width)
        return LearnedPolicy(self.policy, worlds[0].spec, about=self.about, forced=self.forced, eyes=worlds)

    def run(
        self,
        worlds: Sequence[RobosuiteWorld],
        stage: str,
        indices: Sequence[int],
        observers: Callable[[int], Sequence[Observer]] | None = None,
    ) -> Iterator[tuple[int, Outcome]]:
        """Run the episodes of some numbers, in the random stream of a stage; each number with its outcome."""
        recipe, hz, waiting = self.recipe, worlds[0].spec.control_hz, iter(indices)

        def next_start() -> Start | None:
            index = next(waiting, None)
            if index is None:
                return None
            watching = observers(index) if observers else ()
            return Start(index=index, rng=episode_rng(stage, recipe.seed, index), observers=watching)

        horizon, hold_steps = round(recipe.max_seconds * hz), max(1, round(recipe.hold_seconds * hz))
        policy = AskedOnce(self.learned(worlds))
        for start, outcome in rollouts(worlds, policy, next_start, horizon=horizon, hold_steps=hold_steps):
            yield start.index, outcome
