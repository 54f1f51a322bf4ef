"""What a person compares: plans for random weights and a demonstrator's, in one scene, or recordings of plans.

A pool stands as `pool.json` in the reward that is learned from it, so that the same questions can be asked again and
plans can be made in its scenes.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from lfd.core.artifact import sha256
from lfd.core.errors import InputError
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import as_table, build, load_toml
from lfd.loops.arm_candidates import Candidates, ranges_of
from lfd.loops.arm_evidence import Demonstration, Evidence, load_evidence
from lfd.loops.cup_scenes import Placement
from lfd.loops.plan_demonstrations import PlanRecipe, draw_scenes
from lfd.planning.arm_model import load_arm
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.kinematics import Arm
from lfd.planning.trajectory_costs import rest_to_rest

FILE = "pool.json"
DEMONSTRATOR = "demonstrator"
"""Name of the plan for the recipe's own weights."""
RANDOM = 60
"""Random ways that tell by how much features vary beside the planner's prior."""
SMALLEST, LARGEST = 0.1, 1.0
"""Sizes of random weights, in `Pool.units`; uniform in the logarithm."""
TRIES = 5
"""Random weights that are tried for a plan: those whose plan touches something or has no optimum are left out."""


@dataclass(frozen=True, kw_only=True)
class Pool:
    """N trajectories in scenes. Two are compared only within a scene."""

    recipe: PlanRecipe
    """The planner's settings. Its weights are the demonstrator's: only a simulated person may know them."""
    features: tuple[str, ...]
    """Names of the K features that are learned about."""
    scenes: tuple[Placement, ...]
    scene_of: Int[np.ndarray, "N"]
    """Number of each trajectory's scene."""
    names: tuple[str, ...]
    """What each trajectory is."""
    trajectories: Float[np.ndarray, "N T D"]
    """Joint positions at the planner's waypoints [rad]."""
    units: Float[np.ndarray, "K"]
    """Weights at which each feature varies as much as the planner's prior does, over random ways in the first scene."""

    @cached_property
    def arm(self) -> Arm:
        """The arm."""
        return load_arm(self.recipe.robot)

    def planner(self, scene: int, features: Sequence[str] | None = None) -> ArmPlanner:
        """The planner in a scene, for the pool's features or others."""
        about = replace(self.recipe, features=tuple(self.features if features is None else features))
        return about.planner(self.arm, self.scenes[scene])

    def counted(self, features: Sequence[str]) -> Float[np.ndarray, "N K1"]:
        """Counts of some features for each trajectory, and a last column for the planner's prior, -E."""
        found = np.empty((len(self.names), len(features) + 1))
        for scene in range(len(self.scenes)):
            rows, planner = self.scene_of == scene, self.planner(scene, features)
            found[rows, :-1] = planner.features(self.trajectories[rows])
            matrix, x = rest_to_rest(planner.waypoints, planner.dt_s), self.trajectories[rows]
            found[rows, -1] = -0.5 * np.einsum("btd,ts,bsd->b", x, matrix, x)
        return found

    @cached_property
    def counts(self) -> Float[np.ndarray, "N K1"]:
        """f and -E of each trajectory."""
        return self.counted(self.features)

    @cached_property
    def ranges(self) -> Float[np.ndarray, "K1"]:
        """By how much counts vary in a scene, the mean over scenes.

        Raises `InputError` for a feature that is the same for all.
        """
        scenes = [self.counts[self.scene_of == scene] for scene in range(len(self.scenes))]
        found = np.mean([np.ptp(counts, axis=0) for counts in scenes], axis=0)
        for name, spread in zip(self.features, found, strict=False):
            if spread == 0:
                raise InputError(f"{name} is the same for all of the pool: no answer tells its weight; leave it out")
        return found

    @cached_property
    def pairs(self) -> Int[np.ndarray, "P 2"]:
        """All pairs i < j of a scene."""
        first, second = np.triu_indices(len(self.names), 1)
        return np.column_stack([first, second])[self.scene_of[first] == self.scene_of[second]]

    def table(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "recipe": as_table(self.recipe),
            "features": list(self.features),
            "scenes": [placement.table() for placement in self.scenes],
            "scene_of": self.scene_of.tolist(),
            "names": list(self.names),
            "trajectories": self.trajectories.tolist(),
            "units": self.units.tolist(),
        }


def pool_of(table: Mapping[str, Any], where: str) -> Pool:
    """The pool that `Pool.table` wrote. Raises `InputError` for a table that is none."""
    missing = [key for key in Pool.__dataclass_fields__ if key not in table]
    if missing:
        raise InputError(f"{where} lacks {', '.join(missing)}; compare again")
    return Pool(
        recipe=build(PlanRecipe, table["recipe"], where),
        features=tuple(table["features"]),
        scenes=tuple(Placement.of(scene, where) for scene in table["scenes"]),
        scene_of=np.array(table["scene_of"], dtype=int),
        names=tuple(table["names"]),
        trajectories=np.array(table["trajectories"], dtype=float),
        units=np.array(table["units"], dtype=float),
    )


def load_pool(folder: Path) -> Pool:
    """The pool in the folder of a comparison. Raises `InputError` when there is none."""
    path = folder / FILE
    if not path.is_file():
        raise InputError(f"{folder} holds no {FILE}; `lfd compare POOL --out {folder}` makes one")
    try:
        return pool_of(json.loads(path.read_text(encoding="utf-8")), str(path))
    except ValueError as error:
        raise InputError(f"{path} is no pool ({error}); compare again") from error


def make_pool(
    source: Path,
    *,
    features: Sequence[str] | None,
    size: int,
    seed: int,
    overrides: Sequence[str] = (),
    progress: Progress = silent,
) -> tuple[Pool, dict[str, str]]:
    """The pool of a recipe with `size` random plans, or of recordings; and the hash of its source by path.

    `features` are those of the demonstrator if None. Raises `InputError` when fewer than two trajectories of a scene
    differ, and what reading the source raises.
    """
    if source.suffix == ".toml":
        recipe = build(PlanRecipe, load_toml(source, ("plan", "convert"), overrides)["plan"], f"{source} [plan]")
        pool = _of_recipe(recipe, tuple(features or recipe.features), size, seed, progress)
        parents = {str(source): sha256(source)}
    else:
        if overrides:
            raise InputError("--set is for recipes; recordings have no keys to override")
        evidence = load_evidence(source)
        pool = _of_evidence(evidence, tuple(features or evidence.recipe.features), seed)
        parents = dict(evidence.parents)
    pool = _distinct(pool)
    if not len(pool.pairs):
        raise InputError(
            f"{source} has no two different trajectories in a scene, and only those can be compared; record several in "
            "each, `lfd plan RECIPE --set plan.per_scene=3 --noise 0.1`, or give the recipe itself"
        )
    return pool, parents


def _of_recipe(recipe: PlanRecipe, features: tuple[str, ...], size: int, seed: int, progress: Progress) -> Pool:
    """Plans for random weights in the recipe's first scene, after the demonstrator's.

    Weights are normal in `Pool.units`, so that each feature and the planner's prior have a say; so is their size drawn.
    """
    rng = np.random.default_rng([4, seed])
    placement = draw_scenes(replace(recipe, scenes=1))[0]
    demonstrator = recipe.planner(load_arm(recipe.robot), placement)
    plan = demonstrator.plan(np.array(recipe.weights), starts=recipe.starts, rng=rng)
    planner = replace(recipe, features=features).planner(load_arm(recipe.robot), placement)
    units = _units(planner, plan.trajectory[None], recipe.smoothness, rng)
    names, found = [DEMONSTRATOR], [plan.trajectory]
    with progress("plans", size) as bar:
        for number in range(TRIES * size):
            if len(found) > size:
                break
            weights = rng.normal(size=len(features)) * units * np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST)))
            plan = planner.plan(weights, starts=2, rng=rng)
            if plan.collides or not plan.converged:
                continue
            names.append(f"plan {number}")
            found.append(plan.trajectory)
            bar.advance()
    return Pool(
        recipe=replace(recipe, scenes=1),
        features=features,
        scenes=(placement,),
        scene_of=np.zeros(len(found), dtype=int),
        names=tuple(names),
        trajectories=np.array(found),
        units=units,
    )


def _units(
    planner: ArmPlanner, shown: Float[np.ndarray, "N T D"], smoothness: float, rng: np.random.Generator
) -> Float[np.ndarray, "K"]:
    """See `Pool.units`; 1 for a feature that never varies."""
    ranges = ranges_of([Candidates(planner, shown, count=RANDOM, rng=rng)])
    return smoothness * ranges[-1] / np.where(ranges[:-1] > 0, ranges[:-1], smoothness * ranges[-1])


def _of_evidence(evidence: Evidence, features: tuple[str, ...], seed: int) -> Pool:
    scenes = [placement for placement, _ in evidence.scenes]
    placement, shown = evidence.scenes[0]
    rng = np.random.default_rng([4, seed])
    return Pool(
        recipe=evidence.recipe,
        features=features,
        scenes=tuple(scenes),
        scene_of=np.array([scenes.index(one.placement) for one in evidence.demonstrations]),
        names=tuple(Path(one.source).stem for one in evidence.demonstrations),
        trajectories=np.array([one.trajectory for one in evidence.demonstrations]),
        units=_units(evidence.planner(placement, features), shown, evidence.recipe.smoothness, rng),
    )


def _distinct(pool: Pool) -> Pool:
    """The pool without trajectories whose features another one of the scene has: nobody can be asked about those."""
    rows = np.column_stack([pool.scene_of, pool.counts[:, :-1]])
    kept = np.sort(np.unique(rows, axis=0, return_index=True)[1])
    return replace(
        pool,
        scene_of=pool.scene_of[kept],
        names=tuple(pool.names[i] for i in kept),
        trajectories=pool.trajectories[kept],
    )


def shown_in(pool: Pool) -> Evidence:
    """The demonstrator's plan in its scene, for `lfd plan REWARD` where there are no recordings."""
    own = [i for i, name in enumerate(pool.names) if name == DEMONSTRATOR]
    demonstrations = tuple(
        Demonstration(DEMONSTRATOR, pool.scenes[pool.scene_of[i]], pool.trajectories[i]) for i in own
    )
    return Evidence(recipe=pool.recipe, demonstrations=demonstrations, parents={})
