"""DAgger: dataset aggregation, the loop (chapter 10.3, Algorithm 1).

    D <- {}
    for i = 0 to N - 1:
        pi_i = beta_i pi* + (1 - beta_i) pi_hat_i           `lfd.run.control`, or a gate in the coin's place
        sample trajectories of pi_i                          recordings, MCAP
        D_i = {(x, pi*(x))} in the states that pi_i visits   the expert labels every step
        D <- D u D_i                                         the LeRobot dataset grows
        train pi_hat_i+1 on D                                from scratch, or warm
    return pi_hat_N, or the best pi_hat_i in rollouts that judge

(Ross, Gordon, Bagnell 2011, "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning",
Algorithm 3.1; they return the best policy on validation, the chapter the last.) beta_0 is 1: the first round consists
of the demonstrations.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lfd.core.artifact import check_output, new_folder, read_manifest, sha256, write_json, write_manifest
from lfd.core.errors import InputError, OutputError
from lfd.core.protocols import Observers, Progress, silent, unwatched
from lfd.experts.registry import check_expert
from lfd.loops.dagger_person import Person
from lfd.loops.dagger_recipe import HUMAN, LoopRecipes
from lfd.loops.dagger_round import REPORT, Round, Row, evaluated, round_folder
from lfd.worlds.robosuite_world import EVERY_CORE, RobosuiteWorld, make_worlds

MAY_GROW = ("rounds", "max_labels")
"""Keys of [dagger] that may differ when a loop is gone on with, unless something depends on the number of rounds."""
CURVE = "learning_curve.png"


def dagger(
    recipes: LoopRecipes,
    out: Path,
    *,
    most_worlds: int = EVERY_CORE,
    person: Person | None = None,
    watched: Callable[[], Observers] = lambda: unwatched,
    report: Callable[[Row], None] | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Run the loop in the folder `out`; returns what its `report.json` holds.

    `out` then has the dataset, a folder for each round and, as `policy`, the policy that is handed over: the last
    round's, or where rounds are judged the best (the latest of equal ones). Worlds run in parallel, `most_worlds` at
    the most; the result does not depend on how many. With `resume` a loop goes on wherever it was interrupted, and ends
    with the same policy, bit for bit (on a CPU); it may then also run for more rounds.

    `watched` gives what else watches the episodes of rollouts and of an evaluation that begin, `report` takes
    each round's row when it has ended.

    With gate = "human" a `person` is the expert. Raises `OutputError` when `out` exists, or was made by another recipe,
    `InputError` when the person quits or is missing, and what the stages raise.
    """
    if (recipes.dagger.gate == HUMAN) != (person is not None):
        raise InputError(f'gate = "{HUMAN}" and a person belong together: lfd dagger ... --device keyboard')
    if person is None:
        check_expert(recipes.record.task)
    most_worlds = 1 if person is not None else most_worlds
    _begin(out, recipes, resume=resume, overwrite=overwrite)
    rows: list[Row] = []
    record, most = recipes.record, min(most_worlds, recipes.dagger.episodes_per_round)
    worlds = make_worlds(record.task, record.robot, record.control_hz, most=most, progress=progress)
    for number, beta in enumerate(recipes.dagger.betas):
        labels = rows[-1]["labels_total"] if rows else 0
        if rows and 0 < recipes.dagger.max_labels <= labels:
            break
        one = Round(
            number=number,
            beta=beta,
            out=out,
            recipes=recipes,
            worlds=worlds,
            labels_before=labels,
            person=person,
            watched=watched,
            progress=progress,
        )
        rows.append(one.run())
        if report is not None:
            report(rows[-1])
    best = max(rows, key=lambda row: (row.get("judged", 0.0), row["round"]))
    summed = _summed(rows, best) | _final(out, recipes, best, worlds, watched, progress)
    _hand_over(out, best, overwrite=resume or overwrite)
    plot(rows, out / CURVE)
    write_json(out / REPORT, summed)
    return summed


def _begin(out: Path, recipes: LoopRecipes, *, resume: bool, overwrite: bool) -> None:
    """Have the folder of a new loop, or of the one that goes on."""
    if resume:
        _check_same(out, recipes)
    else:
        check_output(out, overwrite=overwrite)
        if out.is_dir():
            shutil.rmtree(out)
        out.mkdir(parents=True)
    write_manifest(out, kind="dagger", recipe=recipes.tables, parents={}, seed=recipes.dagger.seed)


def _check_same(out: Path, recipes: LoopRecipes) -> None:
    manifest = read_manifest(out) if out.is_dir() else None
    if manifest is None or manifest.get("kind") != "dagger":
        raise OutputError(f"{out} holds no loop to go on with; leave --resume out to begin there")
    may_grow = () if recipes.dagger.beta == "linear" or recipes.dagger.last_steps else MAY_GROW
    for name, now in recipes.tables.items():
        before = manifest["recipe"].get(name, {})
        for key in dict.fromkeys([*before, *now]):
            if before.get(key) != now.get(key) and not (name == "dagger" and key in may_grow):
                raise OutputError(
                    f"{out} was made with {name}.{key} = {before.get(key)!r}, the recipe says {now.get(key)!r}; "
                    "go on with the same recipe, or choose another --out"
                )


def _final(
    out: Path,
    recipes: LoopRecipes,
    best: Row,
    worlds: Sequence[RobosuiteWorld],
    watched: Callable[[], Observers],
    progress: Progress,
) -> dict[str, Any]:
    """The evaluation of the policy that is handed over."""
    if "success_rate" not in best:
        return evaluated(round_folder(out, best["round"]) / "policy", recipes.tried, worlds, progress, watched())
    return {key: best[key] for key in ("success_rate", "interval", "successes")}


def _hand_over(out: Path, best: Row, *, overwrite: bool) -> None:
    chosen = round_folder(out, best["round"]) / "policy"
    if (out / "policy").is_dir() and sha256(out / "policy") == sha256(chosen):
        return
    with new_folder(out / "policy", overwrite=overwrite) as part:
        shutil.copytree(chosen, part, dirs_exist_ok=True)


def _summed(rows: Sequence[Row], best: Row) -> dict[str, Any]:
    """What the rounds add up to."""
    sums = {key: sum(row[key] for row in rows) for key in ("labels", "takeovers", "expert_steps", "steps")}
    sums["gradient_steps"] = sum(row["gradient_steps"] for row in rows)
    stages = dict.fromkeys(stage for row in rows for stage in row["seconds"])
    seconds = {stage: round(sum(row["seconds"].get(stage, 0.0) for row in rows), 2) for stage in stages}
    return {"policy_of_round": best["round"], **sums, "seconds": seconds, "rounds": list(rows)}


def plot(rows: Sequence[Row], path: Path) -> None:
    """Success against expert labels, with 95% Wilson intervals, of the rounds that were evaluated."""
    from matplotlib.figure import Figure

    shown = [row for row in rows if "success_rate" in row]
    axes = (figure := Figure(figsize=(6, 3.5), layout="constrained")).subplots()
    if shown:
        rates = [row["success_rate"] for row in shown]
        below = [row["success_rate"] - row["interval"][0] for row in shown]
        above = [row["interval"][1] - row["success_rate"] for row in shown]
        axes.errorbar([row["labels_total"] for row in shown], rates, [below, above], fmt="o-", capsize=3)
    axes.set(xlabel="expert labels", ylabel="success rate", ylim=(-0.02, 1.02), title="DAgger, round by round")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
