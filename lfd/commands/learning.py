"""Commands that learn from demonstrations, and say how well.

Every command imports its stage when it runs, so that `lfd --help` answers at once.
"""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

from lfd.commands.options import (
    Commands,
    Result,
    cluster,
    live,
    machines,
    output,
    overrides,
    parallel,
    put,
    short,
    watching,
    watching_curves,
)


def add(commands: Commands) -> None:
    """The commands of this module."""
    _train(commands)
    _eval(commands)
    _sweep(commands)


def _train(commands: Commands) -> None:
    made = commands.add(
        "train",
        run_train,
        "train a policy on a dataset by behaviour cloning",
        "lfd train policies/bc_mlp.toml --dataset outputs/dataset --out outputs/policy",
    )
    made.epilog += (
        "\n         torchrun --nproc-per-node 2 -m lfd.cli train ...    in two processes, each with half of a batch"
        "\nrecipes: policies/ has bc_mlp, bc_rnn, bc_gmm, act_small, diffusion_small and others;"
        "\n         lfd info policies/bc_mlp.toml explains every key"
    )
    made.add_argument("recipe", type=Path, metavar="RECIPE", help="policy recipe: [policy], [train] and [eval] tables")
    made.add_argument("--dataset", type=Path, required=True, metavar="DATASET", help="LeRobot dataset folder")
    made.add_argument("--steps", type=int, metavar="N", help="gradient steps")
    made.add_argument("--seed", type=int, metavar="S", help="seed of weights and batches")
    made.add_argument("--init", type=Path, metavar="POLICY", help="begin with the weights of this policy")
    made.add_argument(
        "--resume", action="store_true", help="go on from the last checkpoint of a training that was interrupted"
    )
    live(made, "the curves as they grow")
    output(made, "the policy")
    overrides(made)


def run_train(given: Namespace) -> Result:
    """A policy from a dataset."""
    from lfd.core.recipe import build, load_toml
    from lfd.run.judging import rollout_judge
    from lfd.run.trial import EvalRecipe
    from lfd.terminal import progress_bar
    from lfd.train.behavior_cloning import train
    from lfd.train.recipe import TrainRecipe

    tables = load_toml(given.recipe, ("policy", "train", "eval", "dagger"), given.set)
    put(tables, "train", steps=given.steps, seed=given.seed)
    recipe = build(TrainRecipe, tables.get("train", {}), f"{given.recipe} [train]")
    tried = build(EvalRecipe, tables.get("eval", {}), f"{given.recipe} [eval]")
    with watching_curves(given) as report:
        done = train(
            tables.get("policy", {}),
            recipe,
            given.dataset,
            given.out,
            tables=tables,
            init=given.init,
            judge=rollout_judge(tried, recipe.judge_episodes) if recipe.judge_episodes else None,
            report=report,
            resume=given.resume,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    return {"out": str(given.out), **asdict(done)}


def _eval(commands: Commands) -> None:
    made = commands.add(
        "eval",
        run_evaluate,
        "run a policy from unseen start states: success rate with a 95%% Wilson interval",
        "lfd eval outputs/policy --episodes 50 --out outputs/run",
    )
    made.add_argument(
        "policy", type=Path, metavar="POLICY", help="policy folder made by `lfd train`, or by LeRobot's lerobot-train"
    )
    made.add_argument("--episodes", type=int, metavar="N", help="start states to try")
    made.add_argument("--seed", type=int, metavar="S", help="seed of the start states")
    made.add_argument("--robot", metavar="ROBOT", help="run it on another robot than it was trained for; needs --force")
    made.add_argument("--force", action="store_true", help="run it though robot, controller or rate differ")
    made.add_argument(
        "--dataset", type=Path, metavar="DATASET",
        help="what a policy of lerobot-train was trained on, if it has been moved",
    )  # fmt: skip
    live(made, "the worlds in motion, and the success so far")
    parallel(made)
    output(made, "the report and the recordings of all episodes")


def run_evaluate(given: Namespace) -> Result:
    """How often a policy succeeds."""
    from lfd.core.recipe import build
    from lfd.policies.acting import about_policy
    from lfd.run.evaluate import evaluate
    from lfd.run.trial import EvalRecipe
    from lfd.terminal import progress_bar

    tables = about_policy(given.policy, given.dataset)["recipe"]
    put(tables, "eval", episodes=given.episodes, seed=given.seed)
    recipe = build(EvalRecipe, tables["eval"], f"{given.policy} [eval]")
    with watching(given, "evaluation") as begin, machines(given.cluster) as cluster:
        done = evaluate(
            given.policy,
            recipe,
            given.out,
            robot=given.robot,
            forced=given.force,
            dataset=given.dataset,
            most_worlds=given.worlds,
            cluster=cluster,
            observers=begin(),
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    report = asdict(done)
    del report["per_episode"]
    return {"out": str(given.out), **report}


def _sweep(commands: Commands) -> None:
    made = commands.add(
        "sweep",
        run_sweep,
        "train and evaluate a policy for every combination of some values of a recipe",
        "lfd sweep policies/bc_mlp.toml --dataset outputs/dataset --vary train.seed=[0,1,2] --out outputs/sweep",
    )
    made.add_argument("recipe", type=Path, metavar="RECIPE", help="policy recipe: [policy], [train] and [eval] tables")
    made.add_argument(
        "--dataset", type=Path, required=True, metavar="DATASET",
        help="LeRobot dataset folder; for a recipe with a [dagger] table the dataset recipe of its loop",
    )  # fmt: skip
    made.add_argument(
        "--vary", action="append", required=True, metavar="TABLE.KEY=[VALUE,VALUE]",
        help="values to try for a key of the recipe; may be repeated, all combinations are made",
    )  # fmt: skip
    made.add_argument(
        "--results", type=Path, metavar="PAGE.md", help="also write the table into a section of this page"
    )
    cluster(made)
    output(made, "the policies and their evaluations")


def run_sweep(given: Namespace) -> Result:
    """Policies for every combination of some values."""
    from lfd.loops.results import write_section
    from lfd.loops.sweep import rows_of, sweep, title_of
    from lfd.terminal import progress_bar

    with machines(given.cluster) as cluster:
        rows = sweep(
            given.recipe,
            given.vary,
            given.dataset,
            given.out,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    if given.results is not None:
        varied = " ".join(f"--vary {text}" for text in given.vary)
        command = f"lfd sweep {given.recipe} --dataset {given.dataset} {varied}"
        write_section(given.results, title_of(given.recipe, given.dataset), command, rows_of(rows))
    if given.json:
        return {"out": str(given.out), "rows": rows}
    best = {row.pop("folder"): ", ".join(f"{k} {short(v)}" for k, v in row.items()) for row in rows}
    return {"out": str(given.out), **best}
