"""Many policies: every combination of some values of a policy recipe, trained and evaluated.

They come from one dataset, or, for a recipe with a [dagger] table, each from a loop of its own.
"""

import shutil
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lfd.core.artifact import check_output, packed, read_manifest, sha256, unpack, write_json, write_manifest
from lfd.core.errors import RecipeError
from lfd.core.protocols import Progress, UnitMap, silent
from lfd.core.recipe import build, load_toml
from lfd.data.frames import load_frames
from lfd.loops.dagger import CURVE, dagger
from lfd.loops.dagger_recipe import DATA_TABLES, LEARN_TABLES, LoopRecipes
from lfd.run.evaluate import REPORT, evaluate
from lfd.run.judging import rollout_judge
from lfd.run.trial import EvalRecipe
from lfd.run.wilson import wilson_interval
from lfd.train.behavior_cloning import train
from lfd.train.recipe import TrainRecipe
from lfd.worlds.robosuite_world import EVERY_CORE

Tables = Mapping[str, dict[str, Any]]


def combinations(recipe: Path, varied: Sequence[str]) -> list[tuple[dict[str, Any], Tables]]:
    """What is varied, and the tables of the recipe with it, for every combination.

    Each of `varied` is TABLE.KEY=[VALUE, VALUE] with TOML values. Raises `RecipeError` for one that is not, and
    for a combination that is no recipe: before anything is trained.
    """
    choices: dict[str, list[Any]] = {}
    for text in varied:
        name, equals, _ = text.partition("=")
        table, _, key = name.partition(".")
        values = load_toml(recipe, LEARN_TABLES, [text])[table].get(key) if equals else None
        if not isinstance(values, list) or not values:
            raise RecipeError(f"cannot vary {text!r}; write TABLE.KEY=[VALUE, VALUE], for example train.seed=[0, 1]")
        choices[name] = values
    found = []
    for values in product(*choices.values()):
        chosen = dict(zip(choices, values, strict=True))
        tables = load_toml(recipe, LEARN_TABLES)
        for name, value in chosen.items():
            table, _, key = name.partition(".")
            tables.setdefault(table, {})[key] = value
        build(TrainRecipe, tables.get("train", {}), f"{recipe} [train] with {chosen}")
        build(EvalRecipe, tables.get("eval", {}), f"{recipe} [eval] with {chosen}")
        found.append((chosen, tables))
    return found


def sweep(
    recipe: Path,
    varied: Sequence[str],
    source: Path,
    out: Path,
    *,
    cluster: UnitMap | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> list[dict[str, Any]]:
    """Train and evaluate a policy for every combination of what is varied; each lands in a folder of `out`.

    `source` is the dataset, or the dataset recipe of loops. They are made one after the other, or each on a core of a
    `cluster`, with the same result for every episode. Of a loop the policy, its report and its curve are kept. Returns
    a row for each, the best first; `report.json` holds the same. Raises `RecipeError` for what cannot be varied,
    `OutputError` when `out` exists.
    """
    made = combinations(recipe, varied)
    check_output(out, overwrite=overwrite)
    for chosen, tables in made:  # what cannot be used shows before anything is touched
        if "dagger" in tables:
            _loop_recipes(tables, source, f"{recipe} with {chosen}, and {source}:")
    if "dagger" not in made[0][1]:
        load_frames(source, images=False)
    out.mkdir(parents=True, exist_ok=True)
    parents = {str(source): sha256(source)}
    write_manifest(
        out, kind="sweep", recipe={**load_toml(recipe, LEARN_TABLES), "varied": list(varied)}, parents=parents, seed=0
    )
    rows: list[dict[str, Any]] = []
    with progress("sweep", len(made)) as bar:
        all_tables = [tables for _, tables in made]
        if cluster is None:
            results = ((index, _make(source, tables, EVERY_CORE)) for index, tables in enumerate(all_tables))
        else:
            files = packed(source) if source.is_dir() else {source.name: source.read_bytes()}
            results = cluster(_unit, files, all_tables)
        for index, (files, measured) in results:
            chosen, folder = made[index][0], out / f"{index:03d}"
            unpack(files, folder)
            rows.append({"folder": folder.name, **chosen, **measured})
            bar.advance(note=f"{chosen}: {measured['success_rate']:.0%}")
    rows.sort(key=lambda row: (-row["success_rate"], row["folder"]))
    write_json(out / REPORT, {"rows": rows})
    return rows


def title_of(recipe: Path, source: Path) -> str:
    """What a sweep is about, as the title of its results."""
    if source.is_file():
        record = load_toml(source, DATA_TABLES).get("record", {})
        return f"DAgger: {recipe.stem} on {record.get('task')} with {record.get('robot')}"
    about = read_manifest(source) or {}
    return f"Policies: {recipe.stem} on {about.get('task')} with {about.get('robot')}"


def rows_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """A sweep's rows as lines of a table, and all of their episodes together."""
    told = {}
    for row in rows:
        chosen = ", ".join(f"{key} {value}" for key, value in row.items() if "." in key)
        low, high = row["interval"]
        cost = f"{row['labels']} labels" if "labels" in row else f"{row['mean_steps']:.0f} control steps"
        told[chosen] = (
            f"{row['success_rate']:.1%} of {row['episodes']} ({low:.1%} to {high:.1%}), {cost}, "
            f"trained in {row['train_seconds']:.0f} s"
        )
    episodes = sum(row["episodes"] for row in rows)
    solved = sum(round(row["success_rate"] * row["episodes"]) for row in rows)
    low, high = wilson_interval(solved, episodes)
    return {**told, "together": f"{solved / episodes:.1%} of {episodes} ({low:.1%} to {high:.1%})"}


def _loop_recipes(tables: Tables, source: Path, where: str = "the recipe") -> LoopRecipes:
    if source.is_dir():
        raise RecipeError(f"{where} a loop records its own data: give --dataset a dataset recipe, not a dataset")
    return LoopRecipes.of(tables, load_toml(source, DATA_TABLES), where)


def _unit(source: Mapping[str, bytes], tables: Tables) -> tuple[dict[str, bytes], dict[str, Any]]:
    """A worker's part of a sweep: one policy and its evaluation."""
    with TemporaryDirectory() as folder:
        there = Path(folder) / "source"
        unpack(source, there)
        return _make(next(there.iterdir()) if "dagger" in tables else there, tables, 1)


def _make(source: Path, tables: Tables, most_worlds: int) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Make and evaluate one policy: the files of both, and what was measured."""
    with TemporaryDirectory() as folder:
        one = _aggregated if "dagger" in tables else _cloned
        measured = one(source, tables, Path(folder), most_worlds)
        return packed(Path(folder)), measured


def _cloned(dataset: Path, tables: Tables, folder: Path, most_worlds: int) -> dict[str, Any]:
    recipe = build(TrainRecipe, tables.get("train", {}), "[train]")
    tried = build(EvalRecipe, tables.get("eval", {}), "[eval]")
    began = time.perf_counter()
    judge = rollout_judge(tried, recipe.judge_episodes, most_worlds=most_worlds) if recipe.judge_episodes else None
    policy = dict(tables.get("policy", {}))
    trained = train(policy, recipe, dataset, folder / "policy", tables=tables, judge=judge)
    seconds = time.perf_counter() - began
    report = evaluate(folder / "policy", tried, folder / "run", most_worlds=most_worlds)
    return {
        "success_rate": report.success_rate,
        "interval": list(report.interval),
        "episodes": report.episodes,
        "mean_steps": report.mean_steps,
        "loss": trained.loss,
        "train_seconds": round(seconds, 1),
    }


def _aggregated(data: Path, tables: Tables, folder: Path, most_worlds: int) -> dict[str, Any]:
    recipes = _loop_recipes(tables, data)
    with TemporaryDirectory() as elsewhere:
        loop = Path(elsewhere) / "loop"
        report = dagger(recipes, loop, most_worlds=most_worlds)
        for name in ("policy", REPORT, CURVE):
            shutil.move(loop / name, folder / name)
    return {
        "success_rate": report["success_rate"],
        "interval": report["interval"],
        "episodes": recipes.tried.episodes,
        "labels": report["labels"],
        "loss": report["rounds"][report["policy_of_round"]]["loss"],
        "train_seconds": report["seconds"]["train"],
    }
