"""`lfd bench irl` on an arm: the three methods against the number of demonstrations, in cup scenes with a Panda.

The demonstrators plan with the weights of `datasets/cup_panda.toml`, one demonstration in a scene: one does the best,
the other picks trajectories with p ~ exp(-beta cost). Their trajectories are learned from as they are, without a
simulated arm that follows them. Each reward then plans in scenes that were held out:

- **EVD** as `lfd.loops.reward_judging` has it: by how much its plans cost more than plans with the demonstrator's
  weights, under these, as a share of their cost;
- **feature gap** |z_E - z| / |z_E - z_straight|: mean counts, in units of their ranges, of demonstrations, of the
  reward's plans and of the straight ways in these scenes;
- CPU time of learning, drawing candidates included.

Weights that are wrong about one thing can lead to plans that cost a hundred times too much, and means over a few seeds
would tell of nothing else: medians are given, with the smallest and the largest.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.protocols import Bar
from lfd.core.recipe import build, load_toml
from lfd.loops.arm_evidence import Demonstration, Evidence
from lfd.loops.inverse_rl import METHODS, Problem, learn
from lfd.loops.plan_demonstrations import PlanRecipe, demonstrations_in, draw_scenes
from lfd.loops.reward_judging import JUDGE_STREAM, costs
from lfd.planning.arm_planner import ArmPlanner

RECIPE = Path("datasets/cup_panda.toml")
RATIONALITY = 100.0
"""beta of the demonstrator who is not optimal [1/cost]; he pays about 7% too much."""
EXPERTS = {"soft expert": RATIONALITY, "optimal expert": 0.0}


@dataclass(frozen=True, kw_only=True)
class ArmPoint:
    """One method on one set of demonstrations."""

    evd: float
    gap: float
    seconds: float
    """CPU time [s]."""


@dataclass(frozen=True, kw_only=True)
class ArmBench:
    """What one run measured."""

    counts: tuple[int, ...]
    """Numbers of demonstrations, each in a scene of its own."""
    held_out: int
    """Scenes in which rewards are judged."""
    seeds: tuple[int, ...]
    points: dict[str, dict[str, list[list[ArmPoint]]]]
    """Expert to method to its points at every count, each with one for every seed."""
    experts: dict[str, list[float]]
    """Expert to the EVD of its own demonstrations in every seed."""


@dataclass(frozen=True, eq=False)
class _Judged:
    """A scene held out."""

    planner: ArmPlanner
    shown: Float[np.ndarray, "T D"]
    """The demonstration."""
    best: float
    """Cost of the plan with the demonstrator's weights."""


def bench_arm(*, counts: Sequence[int], held_out: int, seeds: Sequence[int], bar: Bar) -> ArmBench:
    """Measure the methods; `bar` advances once for each seed."""
    recipe = build(PlanRecipe, load_toml(RECIPE, ("plan", "convert"))["plan"], f"{RECIPE} [plan]")
    points = {e: {m: [[] for _ in counts] for m in METHODS} for e in EXPERTS}
    own: dict[str, list[float]] = {expert: [] for expert in EXPERTS}
    for seed in seeds:
        for expert, rationality in EXPERTS.items():
            used = replace(recipe, scenes=max(counts) + held_out, seed=seed, rationality=rationality)
            evidence, judged = _demonstrated(used, held_out)
            own[expert].append(float(np.mean([_loss(used, scene, scene.shown) for scene in judged])))
            for place, count in enumerate(counts):
                few = replace(evidence, demonstrations=evidence.demonstrations[:count])
                for method in METHODS:
                    points[expert][method][place].append(_point(few, method, judged, seed))
        bar.advance(note=f"cup scenes, seed {seed}")
    return ArmBench(counts=tuple(counts), held_out=held_out, seeds=tuple(seeds), points=points, experts=own)


def _demonstrated(recipe: PlanRecipe, held_out: int) -> tuple[Evidence, list[_Judged]]:
    """Demonstrations to learn from, and the last scenes."""
    evidence = Evidence(recipe=recipe, demonstrations=(), parents={})
    demonstrations, judged = [], []
    for number, placement in enumerate(draw_scenes(recipe)):
        plan, (way,) = demonstrations_in(recipe, number, placement)
        if number < recipe.scenes - held_out:
            demonstrations.append(Demonstration(f"scene {number}", placement, np.array(way)))
        else:
            judged.append(_Judged(recipe.planner(evidence.arm, placement), np.array(way), plan.cost))
    return replace(evidence, demonstrations=tuple(demonstrations)), judged


def _point(evidence: Evidence, method: str, judged: Sequence[_Judged], seed: int) -> ArmPoint:
    """How the plans of what a method learned do in the scenes held out."""
    recipe, began = evidence.recipe, time.process_time()
    problem = Problem(evidence, recipe.features, seed=seed)
    reward, _ = learn(problem, method, evidence)
    seconds = time.process_time() - began
    plans = []
    for number, scene in enumerate(judged):
        rng = np.random.default_rng([JUDGE_STREAM, seed, number])
        plans.append(scene.planner.plan(reward.weights, starts=recipe.starts, rng=rng).trajectory)
    shown, planned, straight = (
        np.mean([scene.planner.features(way[None])[0] for scene, way in zip(judged, ways, strict=True)], axis=0)
        for ways in ([s.shown for s in judged], plans, [s.planner.straight() for s in judged])
    )
    ranges = problem.ranges[:-1]
    return ArmPoint(
        evd=float(np.mean([_loss(recipe, scene, way) for scene, way in zip(judged, plans, strict=True)])),
        gap=float(np.linalg.norm((shown - planned) / ranges) / np.linalg.norm((shown - straight) / ranges)),
        seconds=seconds,
    )


def _loss(recipe: PlanRecipe, scene: _Judged, way: Float[np.ndarray, "T D"]) -> float:
    """By how much a trajectory costs more than the plan with the demonstrator's weights, as a share of that."""
    (cost,) = costs(scene.planner, recipe.weights, recipe.smoothness, way[None])
    return float((cost - scene.best) / abs(scene.best))


def rows_of(measured: ArmBench) -> dict[str, str]:
    """Rows of a results page."""
    rows = {
        "scenes": f"{len(measured.seeds)} x {measured.held_out} held out; medians over seeds, (smallest to largest)",
    }
    for expert, methods in measured.points.items():
        rows[f"EVD of the {expert} itself"] = _said(measured.experts[expert])
        for what, field in (("EVD of the weights", "evd"), ("feature gap", "gap")):
            for place, count in enumerate(measured.counts):
                said = [f"{m} {_said([getattr(p, field) for p in at[place]])}" for m, at in methods.items()]
                rows[f"{what}, {expert}, {count} demonstration{'s' * (count > 1)}"] = "; ".join(said)
        times = [f"{m} {np.median([p.seconds for p in at[-1]]):.2g} s" for m, at in methods.items()]
        rows[f"CPU time, {expert}, {measured.counts[-1]} demonstrations, median"] = "; ".join(times)
    return rows


def _said(values: Sequence[float]) -> str:
    middle = float(np.median(values))
    return f"{middle:.3g}" if len(values) == 1 else f"{middle:.3g} ({min(values):.3g} to {max(values):.3g})"


def draw(measured: ArmBench, expert: str, above: Any, below: Any, colours: Sequence[str]) -> None:
    """EVD and feature gap of an expert's learners in two axes: medians, in bands from smallest to largest."""
    for (method, at), colour in zip(measured.points[expert].items(), colours, strict=True):
        for axes, field in ((above, "evd"), (below, "gap")):
            values = np.array([[getattr(point, field) for point in points] for points in at])
            axes.plot(measured.counts, np.median(values, axis=1), "o-", color=colour, label=method, markersize=4)
            axes.fill_between(
                measured.counts, values.min(axis=1), values.max(axis=1), color=colour, alpha=0.15, linewidth=0
            )
    above.axhline(float(np.median(measured.experts[expert])), color="0.5", linestyle=":", label="the expert")
    above.set_yscale("symlog", linthresh=0.01)
    above.set(title=f"cup, Panda, {expert}", ylabel="regret (0: optimal plans)", ylim=(-0.05, None))
    below.set(xlabel="demonstrations", yscale="log", ylabel="feature gap (1: the straight way)")
    for axes in (above, below):
        axes.set_xticks(measured.counts)
