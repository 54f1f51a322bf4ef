"""Commands on rewards of arms: demonstrations by a planner, features, inverse RL, plans with what was learned.

Every command imports its stage when it runs, so that `lfd --help` answers at once.
"""

import json
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lfd.commands.options import Commands, Result, count, output, overrides, put
from lfd.core.errors import InputError

METHODS = ("apprenticeship", "margin", "maxent")
"""Names of `lfd.loops.inverse_rl`, which is imported when one runs."""
PEOPLE = "people"
"""`lfd.loops.learning_people`: for what people did, not the arm."""
TABLES = ("plan", "convert")


def add(commands: Commands) -> None:
    """The commands of this module."""
    _plan(commands)
    _features(commands)
    _irl(commands)


def _plan(commands: Commands) -> None:
    made = commands.add(
        "plan",
        run_plan,
        "plan an arm's motions for a reward, run them on the simulated arm and record them",
        "lfd plan datasets/cup_panda.toml --out outputs/cup",
    )
    made.epilog += "\n         lfd plan outputs/reward --out outputs/plans --save plan.rrd"
    made.add_argument(
        "reward", type=Path, metavar="RECIPE|REWARD",
        help="recipe of a demonstrator, a TOML file with a [plan] table; or the folder of a learned reward: it plans "
        "in the scenes of the demonstrations",
    )  # fmt: skip
    made.add_argument("--robot", metavar="NAME", help="robot config in the recipe's place")
    made.add_argument("--demonstrations", type=count, metavar="N", help="scenes to plan in")
    made.add_argument("--noise", type=float, metavar="RAD", help="deviation of each joint from the plan, in its middle")
    made.add_argument("--seed", type=int, metavar="S", help="seed of scenes, plans and noise")
    made.add_argument(
        "--beside", type=Path, metavar="RECORDINGS",
        help="demonstrations in whose scenes a reward plans (default: those that it was learned from)",
    )  # fmt: skip
    made.add_argument(
        "--save", type=Path, metavar="X.rrd", help="also write a plan beside its demonstrations as a Rerun file"
    )
    made.add_argument("--episode", type=int, default=0, metavar="I", help="the plan that --save shows (default: 0)")
    output(made, "the recordings")
    overrides(made)


def run_plan(given: Namespace) -> Result:
    """Recordings of plans."""
    from lfd.core.artifact import check_output
    from lfd.loops.arm_evidence import load_evidence
    from lfd.loops.plan_demonstrations import demonstrate
    from lfd.loops.plans_beside import clip_beside, compared
    from lfd.terminal import progress_bar

    check_output(given.out, overwrite=given.overwrite)
    if given.save is not None and given.save.exists() and not given.overwrite:
        raise InputError(f"{given.save} exists already; choose another --save, or add --overwrite to replace it")
    is_recipe = given.reward.suffix == ".toml" or not given.reward.is_dir()
    recipe, scenes, tables, shown = (_of_recipe if is_recipe else _of_reward)(given)
    if given.save is not None and not 0 <= given.episode < len(scenes) * recipe.per_scene:
        raise InputError(f"--episode {given.episode}: there will be plans 0 to {len(scenes) * recipe.per_scene - 1}")
    done = demonstrate(recipe, scenes, given.out, tables=tables, overwrite=given.overwrite, progress=progress_bar)
    result = {"out": str(given.out), **asdict(done)}
    if shown is not None:
        result |= compared(given.out, shown)
    if given.save is not None:
        from lfd.replay.rerun_scene import replay

        clip, shapes = clip_beside(given.out, given.episode, shown or load_evidence(given.out))
        replay(clip, save=given.save, overwrite=given.overwrite, shapes=shapes)
        result["saved"] = str(given.save)
    return result


def _of_recipe(given: Namespace) -> tuple[Any, list[Any], dict[str, Any], None]:
    """Recipe, scenes and tables of a demonstrator."""
    from lfd.core.recipe import build, load_toml
    from lfd.loops.plan_demonstrations import PlanRecipe, draw_scenes

    if given.beside is not None:
        raise InputError("--beside is for a learned reward; a recipe draws its own scenes")
    tables = load_toml(given.reward, TABLES, given.set)
    put(tables, "plan", robot=given.robot, scenes=given.demonstrations, noise_rad=given.noise, seed=given.seed)
    recipe = build(PlanRecipe, tables["plan"], f"{given.reward} [plan]")
    return recipe, draw_scenes(recipe), tables, None


def _of_reward(given: Namespace) -> tuple[Any, list[Any], dict[str, Any], Any]:
    """Recipe, scenes, tables and demonstrations of a learned reward."""
    from lfd.loops.plan_demonstrations import PlanRecipe
    from lfd.loops.plans_beside import shown_for
    from lfd.rewards.reward_artifact import load_reward

    reward = load_reward(given.reward)
    shown = shown_for(given.reward, given.beside)
    if given.set:
        raise InputError("--set is for recipes; a learned reward has no keys to override")
    robot = given.robot or reward.robot
    if robot != shown.recipe.robot:
        raise InputError(
            f"the scenes are for {shown.recipe.robot!r}, not {robot!r}; name others with --beside RECORDINGS"
        )
    scenes = [placement for placement, _ in shown.scenes][: given.demonstrations]
    about = shown.recipe
    recipe = PlanRecipe.of_reward(
        reward,
        control_hz=about.control_hz,
        scenes=len(scenes),
        seed=about.seed if given.seed is None else given.seed,
        starts=about.starts,
        noise_rad=given.noise or 0.0,
    )
    return recipe, scenes, {}, shown


def _features(commands: Commands) -> None:
    made = commands.add(
        "features",
        run_features,
        "count features in demonstrations: means with standard errors",
        "lfd features outputs/cup",
    )
    made.add_argument(
        "source", type=Path, metavar="RECORDINGS|DATASET", help="recordings of plans, or the dataset made of them"
    )
    _feature_names(made, "all that the scenes allow")


def run_features(given: Namespace) -> Result:
    """Mean feature counts."""
    from lfd.loops.arm_evidence import load_evidence
    from lfd.rewards.arm_features import ARM_FEATURES, arm_features
    from lfd.rewards.feature_counts import feature_expectations

    evidence = load_evidence(given.source)
    names = given.features or tuple(name for name in ARM_FEATURES if name != "obstacle_closeness")
    counts = evidence.counts(names)
    found = feature_expectations([row[None] for row in counts], discount=1.0)
    rows = {
        feature.name: {"mean": float(mean), "standard_error": float(error), "unit": f"{feature.unit} s"}
        for feature, mean, error in zip(arm_features(names), found.mean, found.standard_error, strict=True)
    }
    if given.json:
        return {"demonstrations": len(counts), "features": rows}
    told = {n: f"{r['mean']:.4g} +- {r['standard_error']:.2g} {r['unit']}" for n, r in rows.items()}
    return {"demonstrations": len(counts), **told}


def _irl(commands: Commands) -> None:
    made = commands.add(
        "irl",
        run_irl,
        "learn what a demonstrator wants: weights of features from demonstrations in scenes",
        "lfd irl maxent --dataset outputs/cup --out outputs/reward",
    )
    made.epilog += "\n         lfd irl margin --dataset outputs/cup --holdout 3 --out outputs/judged"
    made.epilog += "\n         lfd irl people --dataset outputs/merge --type aggressive --out outputs/aggressive"
    made.add_argument(
        "method", choices=(*METHODS, PEOPLE),
        help="apprenticeship (Abbeel and Ng), margin (maximum margin planning), maxent (maximum entropy), people "
        "(maximum entropy over what the people of `lfd interact` chose)",
    )  # fmt: skip
    made.add_argument(
        "--dataset", type=Path, required=True, metavar="RECORDINGS|DATASET",
        help="recordings of plans (`lfd plan`), or the LeRobot dataset made of them; people: recordings of `lfd "
        "interact` with people of one type",
    )  # fmt: skip
    _feature_names(made, "those of the demonstrator")
    made.add_argument(
        "--holdout", type=int, default=0, metavar="N",
        help="scenes (people: recordings), the last ones, that nothing is learned from; where the demonstrator's "
        "weights are known, they judge the learned reward's plans there",
    )  # fmt: skip
    made.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the candidates (default: 0)")
    made.add_argument(
        "--type",
        metavar="TYPE",
        help="people: whose weights they are, passive or aggressive, at the table yields or insists",
    )
    made.add_argument(
        "--rationality", type=float, default=0.3, metavar="R",
        help="people: how strictly they choose what is best; it sets the scale of the weights (default: 0.3)",
    )  # fmt: skip
    made.add_argument(
        "--reward", type=Path, metavar="OLD",
        help="a reward to which the demonstrations are added as further evidence, whatever it was learned from; "
        "maxent only",
    )  # fmt: skip
    output(made, "the reward")


def run_irl(given: Namespace) -> Result:
    """A reward from demonstrations."""
    if given.method == PEOPLE:
        return _learn_people(given)
    from lfd.core.artifact import check_output, sha256
    from lfd.loops.arm_evidence import load_evidence
    from lfd.loops.inverse_rl import Problem, convergence_picture, identifiable, joined, learn
    from lfd.loops.reward_judging import regret, split
    from lfd.rewards.reward_artifact import load_reward, save_reward
    from lfd.terminal import progress_bar

    check_output(given.out, overwrite=given.overwrite)
    if given.reward and given.method != "maxent":
        raise InputError(f"--reward joins evidence by its likelihood, which {given.method} has not; use lfd irl maxent")
    old = load_reward(given.reward) if given.reward else None
    evidence, held_out = split(load_evidence(given.dataset), given.holdout)
    features = given.features or (evidence.recipe.features if old is None else old.features)
    problem = Problem(evidence, features, seed=given.seed, progress=progress_bar)
    reward, found = learn(problem, given.method, evidence)
    parents = dict(evidence.parents)
    if old is not None:
        reward, parents = joined(old, reward), parents | {str(given.reward): sha256(given.reward)}
    told = identifiable(problem)
    rows = {
        name: {"weight": float(w), "unit": f"1/({unit})", "per_range": float(w * spread), "identifiable": known}
        for name, unit, w, spread, known in zip(
            features, reward.units, reward.weights, reward.ranges, told, strict=True
        )
    }
    report: Result = {"demonstrations": len(evidence.demonstrations), "weights": rows, **found.measures}
    if given.holdout:
        report["regret"] = asdict(regret(reward, held_out, seed=given.seed))
    save_reward(
        reward,
        given.out,
        recipe={"method": given.method, "features": list(features), "holdout": given.holdout},
        parents=parents,
        seed=given.seed,
        overwrite=given.overwrite,
        also={
            "convergence.png": convergence_picture(found, given.method),
            "report.json": json.dumps(report, indent=2).encode(),
        },
    )
    return {"out": str(given.out), **(report if given.json else _shown(report))}


def _learn_people(given: Namespace) -> Result:
    """What people are after, from recordings of interactions."""
    from lfd.interaction.person_reward import LEARNABLE
    from lfd.loops.learning_people import learn_people
    from lfd.terminal import progress_bar

    if given.features or given.reward:
        raise InputError("lfd irl people has features of its own and learns a reward anew: leave them out")
    if given.type is None:
        raise InputError(f"whose weights are they? give --type TYPE, one of {', '.join(LEARNABLE)}")
    report = learn_people(
        given.dataset, given.type, given.out, holdout=given.holdout, rationality=given.rationality,
        overwrite=given.overwrite, progress=progress_bar,
    )  # fmt: skip
    if given.json:
        return {"out": str(given.out), **asdict(report)}
    reward, held_out = report.reward, report.held_out or {}
    rows = zip(reward.features, reward.weights, reward.spread, strict=True)
    told: Result = {"out": str(given.out), **{name: f"{w:.4g} +- {s:.2g}" for name, w, s in rows}}
    told["choices"] = f"{reward.choices}, {reward.log_likelihood:.3f} nat each" + " (NOT CONVERGED)" * (
        not report.converged
    )
    if held_out:
        told["held out"] = "nat for each choice: " + ", ".join(f"{name} {x:.3f}" for name, x in held_out.items())
    return told


def _shown(report: Result) -> Result:
    """A report as lines of a table."""
    told = {
        name: f"{row['weight']:.4g} {row['unit']}, {row['per_range']:.3g} over its range"
        + ("" if row["identifiable"] else ", NOT IDENTIFIABLE: the demonstrations do not tell it from others")
        for name, row in report.pop("weights").items()
    }
    judged = report.pop("regret", None)
    if judged is not None:
        report["regret"] = (
            f"{judged['mean']:.1%} in the mean, {judged['worst']:.1%} at worst, of {judged['scenes']} held-out scenes: "
            "what its plans cost more than the demonstrations, by its demonstrator's own weights (only used here)"
        )
    return {**told, **report}


def _feature_names(made: Any, default: str) -> None:
    made.add_argument(
        "--features", type=lambda text: tuple(text.split(",")), metavar="A,B,C",
        help=f"names of features, separated by commas (default: {default})",
    )  # fmt: skip
