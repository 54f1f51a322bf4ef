"""`lfd bench dagger`: success against expert labels, of cloned policies and of DAgger's, at equal budgets.

Four learners of the same build, over several seeds, each of which draws demonstrations, weights, rollouts and the start
states of the evaluation, the same ones for all learners:

    BC                 whole demonstrations without noise
    BC, noisy expert   the same with noise on what is applied; the label is what the expert meant (DART)
    DAgger             a few demonstrations without noise, then the learner's own episodes, labelled; from scratch
    DAgger, warm       the same, each round going on from the weights of the last

DAgger's rounds end at a label; BC gets whole demonstrations, and never fewer labels than DAgger had.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lfd.convert.to_lerobot import convert
from lfd.core.errors import UnknownName
from lfd.core.processes import ProcessMap, cores, in_order
from lfd.core.protocols import Progress, silent
from lfd.core.recipe import Table, load_toml
from lfd.loops.dagger import dagger
from lfd.loops.dagger_recipe import DATA_TABLES, LEARN_TABLES, LoopRecipes
from lfd.loops.dagger_round import counts_of, evaluated, round_folder
from lfd.record.demonstrations import record
from lfd.record.mcap_file import SUFFIX
from lfd.run.wilson import wilson_interval
from lfd.train.behavior_cloning import train
from lfd.worlds.robosuite_world import RobosuiteWorld, make_worlds

BC, NOISY, SCRATCH, WARM = "BC", "BC, noisy expert", "DAgger", "DAgger, warm"
COLOURS = {BC: "C3", NOISY: "C1", SCRATCH: "C0", WARM: "C2"}
RECIPES = {"Lift": ("policies/dagger_lift.toml", "datasets/lift_panda.toml")}
"""Task to its policy recipe and its dataset recipe."""
LABELS, NOISE = 200, 0.2
"""Labels of a round of DAgger; noise of the noisy expert [action]."""
SPARE = 1.3
"""Demonstrations recorded for BC, as a multiple of those that the largest budget needs at their mean length."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What all seeds share."""

    learn: Mapping[str, Table]
    """Tables of the policy recipe; their seeds are replaced."""
    data: Mapping[str, Table]
    """Tables of the dataset recipe; its seed and noise are replaced."""
    marks: tuple[int, ...]
    """Rounds after which policies are compared, the first being 0."""
    noise: float
    """Noise of the noisy expert [action]."""

    def recipes(self, seed: int, *, noise: float = 0.0, **dagger: Any) -> LoopRecipes:
        """The recipes of a seed, with some keys of [dagger]."""
        learn = {name: dict(table) for name, table in self.learn.items()}
        learn["train"]["seed"] = learn["eval"]["seed"] = seed
        learn["dagger"] |= {"seed": seed, "rounds": self.marks[-1] + 1, "evaluate": "last", **dagger}
        record = {**self.data["record"], "seed": seed, "action_noise": noise}
        return LoopRecipes.of(learn, {**self.data, "record": record}, "lfd bench dagger:")


@dataclass(frozen=True, kw_only=True)
class Point:
    """One policy: what it cost, and what it can do."""

    labels: int
    successes: int
    gradient_steps: int
    """Gradient steps up to it, those of earlier rounds included."""
    seconds: float
    """Time of those steps [s]; 0 where they were not timed."""


@dataclass(frozen=True, kw_only=True)
class DaggerBench:
    """What one run measured."""

    task: str
    episodes: int
    """Start states that each policy was tried from, in each seed."""
    seeds: tuple[int, ...]
    points: dict[str, list[list[Point]]]
    """Learner to its points at every mark, each with one for every seed."""


def setting_of(task: str, *, quick: bool) -> Setting:
    """The comparison on a task, with the recipes of this repository.

    Raises `UnknownName` for a task without a recipe.
    """
    if task not in RECIPES:
        raise UnknownName("task of this comparison", task, RECIPES)
    learn, data = (Path(path) for path in RECIPES[task])
    tables = load_toml(learn, LEARN_TABLES), load_toml(data, DATA_TABLES)
    tables[0]["dagger"] |= {"labels_per_round": LABELS, "episodes_per_round": LABELS, "demonstrations": 4}
    if quick:
        tables[0]["train"]["steps"], tables[0]["dagger"]["warm_steps"] = 200, 50
        tables[0]["eval"] |= {"episodes": 5, "max_seconds": 4.0}
    return Setting(learn=tables[0], data=tables[1], marks=(0, 1) if quick else (0, 1, 2, 4, 6, 9), noise=NOISE)


def bench_dagger(setting: Setting, *, seeds: Sequence[int], progress: Progress = silent) -> DaggerBench:
    """Compare the learners over some seeds, each in a process of its own."""
    recipes = setting.recipes(seeds[0])
    found: list[dict[str, list[Point]]] = []
    with progress("bench dagger", len(seeds)) as bar:
        for points in in_order(ProcessMap(min(cores(), len(seeds)))(_one_seed, setting, list(seeds))):
            found.append(points)
            best = {name: f"{row[-1].successes / recipes.tried.episodes:.0%}" for name, row in points.items()}
            bar.advance(note=", ".join(f"{name} {rate}" for name, rate in best.items()))
    by_mark = {
        name: [[points[name][mark] for points in found] for mark in range(len(setting.marks))] for name in found[0]
    }
    return DaggerBench(task=recipes.record.task, episodes=recipes.tried.episodes, seeds=tuple(seeds), points=by_mark)


def _one_seed(setting: Setting, seed: int) -> dict[str, list[Point]]:
    """A worker's part: all learners of a seed."""
    recipes = setting.recipes(seed)
    record_ = recipes.record
    worlds = make_worlds(record_.task, record_.robot, record_.control_hz, most=1)
    with TemporaryDirectory() as folder:
        out = Path(folder)
        points = {SCRATCH: _aggregated(setting, recipes, out / "scratch", worlds)}
        points[WARM] = _aggregated(setting, setting.recipes(seed, retrain="warm"), out / "warm", worlds)
        budgets = [point.labels for point in points[SCRATCH]]
        points[BC] = list(_cloned(recipes, out / "clean", budgets, worlds))
        points[NOISY] = list(_cloned(setting.recipes(seed, noise=setting.noise), out / "noisy", budgets, worlds))
    return {name: points[name] for name in (BC, NOISY, SCRATCH, WARM)}


def _aggregated(setting: Setting, recipes: LoopRecipes, out: Path, worlds: Sequence[RobosuiteWorld]) -> list[Point]:
    """DAgger's policies at the marks."""
    rounds, points = dagger(recipes, out, most_worlds=1)["rounds"], []
    for mark in setting.marks:
        done, policy = rounds[: mark + 1], round_folder(out, mark) / "policy"
        points.append(
            Point(
                labels=rounds[mark]["labels_total"],
                successes=evaluated(policy, recipes.tried, worlds, silent)["successes"],
                gradient_steps=sum(row["gradient_steps"] for row in done),
                seconds=sum(row["seconds"]["train"] for row in done),
            )
        )
    return points


def _cloned(
    recipes: LoopRecipes, out: Path, budgets: Sequence[int], worlds: Sequence[RobosuiteWorld]
) -> Iterator[Point]:
    """Policies cloned from as many demonstrations as it takes to have the labels of each budget."""
    files, labels = _demonstrations(recipes, out / "recordings", budgets[-1])
    total, taken = np.cumsum(labels), 0
    for number, budget in enumerate(budgets):
        needed = int(np.searchsorted(total, budget)) + 1
        if needed > taken:
            convert(files[taken:needed], out / "dataset", recipe=recipes.source, append=taken > 0)
            taken = needed
        policy = out / f"policy_{number}"
        done = train(recipes.policy, recipes.train, out / "dataset", policy, tables=recipes.tables)
        solved = evaluated(policy, recipes.tried, worlds, silent)["successes"]
        yield Point(labels=int(total[needed - 1]), successes=solved, gradient_steps=done.steps, seconds=0.0)


def _demonstrations(recipes: LoopRecipes, out: Path, budget: int) -> tuple[list[Path], list[int]]:
    """Recordings with at least `budget` labels, and the labels of each."""
    files, labels, wanted = list[Path](), [0], recipes.record.episodes
    while sum(labels) < budget:
        record(replace(recipes.record, episodes=wanted), out, tables=recipes.tables, most_worlds=1, resume=out.is_dir())
        files = sorted(out.glob(f"*{SUFFIX}"))
        labels = [counts_of(file).labels for file in files]
        wanted = max(wanted + 1, round(SPARE * budget * len(files) / sum(labels)))
    return files, labels


def rows_of(measured: DaggerBench) -> dict[str, str]:
    """The lines of a results page."""
    count = measured.episodes
    rows = {"policies": f"{len(measured.seeds)} seeds, each policy tried from {count} unseen starts of its seed"}
    for mark, dagger_points in enumerate(measured.points[SCRATCH]):
        said = [f"{name} {_success(points[mark], count)}" for name, points in measured.points.items()]
        rows[f"about {np.mean([point.labels for point in dagger_points]):.0f} labels"] = "; ".join(said)
    for goal in (0.9, 0.95, 0.99):
        said = [f"{name} {_labels_for(points, count, goal)}" for name, points in measured.points.items()]
        rows[f"labels for {goal:.0%} success over all seeds"] = ", ".join(said)
    for name in (SCRATCH, WARM):
        last = measured.points[name][-1]
        steps, seconds = (np.mean([getattr(p, key) for p in last]) for key in ("gradient_steps", "seconds"))
        rows[f"retraining, {name}"] = f"{steps:.0f} gradient steps, {seconds:.1f} s, success {_success(last, count)}"
    return rows


def _success(points: Sequence[Point], episodes: int) -> str:
    """The success of all seeds together, with its interval, and of the worst and the best one."""
    solved, tried = sum(point.successes for point in points), episodes * len(points)
    low, high = wilson_interval(solved, tried)
    worst, best = (pick(point.successes for point in points) / episodes for pick in (min, max))
    return f"{solved / tried:.1%} [{low:.1%}, {high:.1%}], seeds {worst:.0%} to {best:.0%}"


def _labels_for(marks: Sequence[Sequence[Point]], episodes: int, goal: float) -> str:
    """The fewest labels from which on all policies together reach a success rate at every mark."""
    needed = ""
    for points in reversed(marks):
        if np.mean([point.successes / episodes for point in points]) < goal:
            break
        needed = f"{np.mean([point.labels for point in points]):.0f}"
    return needed or f"more than {np.mean([point.labels for point in marks[-1]]):.0f}"


def plot(measured: DaggerBench, path: Path) -> None:
    """Success against labels: all seeds together with 95% Wilson intervals, and each seed as a faint line."""
    from matplotlib.figure import Figure

    axes = (figure := Figure(figsize=(6.5, 4.0), layout="constrained")).subplots()
    for name, marks in measured.points.items():
        labels = [np.mean([point.labels for point in points]) for points in marks]
        tried = measured.episodes * len(measured.seeds)
        solved = [sum(point.successes for point in points) for points in marks]
        rates = np.array(solved) / tried
        ends = np.array([wilson_interval(each, tried) for each in solved])
        errors = np.abs(ends.T - rates)
        axes.errorbar(labels, rates, errors, fmt="o-", capsize=3, color=COLOURS[name], label=name)
        for seed in range(len(measured.seeds)):
            own = [points[seed] for points in marks]
            axes.plot(
                [p.labels for p in own], [p.successes / measured.episodes for p in own],
                color=COLOURS[name], alpha=0.2, linewidth=0.8,
            )  # fmt: skip
    axes.set(xlabel="expert labels", ylabel="success rate", ylim=(-0.02, 1.02), title=f"{measured.task}, by labels")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=150)
