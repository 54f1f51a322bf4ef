"""The command that aggregates a dataset: DAgger."""

from argparse import Namespace
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from lfd.commands.demonstrations import live_view
from lfd.commands.options import ALL_WORLDS, Commands, Result, count, live, output, overrides, put, watching
from lfd.core.errors import InputError
from lfd.experts.keys import HELP


def add(commands: Commands) -> None:
    """The command of this module."""
    made = commands.add(
        "dagger",
        run_dagger,
        "learn with the expert at hand: roll out, have every state labelled, retrain, round by round (DAgger)",
        "lfd dagger policies/dagger_lift.toml --out outputs/dagger",
    )
    made.epilog += "\n         lfd dagger policies/dagger_lift.toml --set dagger.retrain=warm --out outputs/warm"
    made.epilog += f"\n         lfd dagger policies/dagger_lift.toml --device keyboard --out outputs/mine\n\n{HELP}"
    made.add_argument(
        "recipe", type=Path, metavar="RECIPE", help="policy recipe: [policy], [train], [eval] and [dagger] tables"
    )
    made.add_argument(
        "--dataset-recipe", type=Path, default=Path("datasets/lift_panda.toml"), metavar="RECIPE",
        help="what is demonstrated, and how it becomes a dataset (default: datasets/lift_panda.toml)",
    )  # fmt: skip
    made.add_argument("--rounds", type=count, metavar="N", help="rounds, the demonstrations among them")
    made.add_argument("--seed", type=int, metavar="S", help="seed of the rollouts")
    made.add_argument(
        "--resume", action="store_true", help="go on with a loop that was interrupted, or for more rounds"
    )
    made.add_argument(
        "--device", metavar="DEVICE",
        help="you are the expert, with keyboard, spacemouse or gamepad: you demonstrate the first round, then take "
        "over from the learner where it goes wrong (HG-DAgger)",
    )  # fmt: skip
    made.add_argument("--no-view", action="store_true", help="with --device: no live view of the robot")
    made.add_argument(
        "--worlds", type=count, default=ALL_WORLDS, metavar="N",
        help="worlds to run in parallel at the most; the result is the same (default: one a core)",
    )  # fmt: skip
    live(made, "the worlds in motion, and the success of each round's rollouts and evaluation so far")
    output(made, "the dataset, the rounds and the policy")
    overrides(made)


def run_dagger(given: Namespace) -> Result:
    """A policy, and how it got there."""
    from lfd.core.recipe import load_toml
    from lfd.loops.dagger import dagger
    from lfd.loops.dagger_recipe import DATA_TABLES, LEARN_TABLES, LoopRecipes
    from lfd.terminal import progress_bar

    overridden = [(text, text.partition(".")[0].strip() in DATA_TABLES) for text in given.set]
    learn = load_toml(given.recipe, LEARN_TABLES, [text for text, is_data in overridden if not is_data])
    data = load_toml(given.dataset_recipe, DATA_TABLES, [text for text, is_data in overridden if is_data])
    put(learn, "dagger", rounds=given.rounds, seed=given.seed, gate=None if given.device is None else "human")
    if given.no_view and given.device is None:
        raise InputError("--no-view is for people: choose their device with --device keyboard, spacemouse or gamepad")
    if given.live and given.device is not None:
        raise InputError(f"with --device {given.device} you see the robot already: leave out --live")
    recipes = LoopRecipes.of(learn, data, f"{given.recipe} and {given.dataset_recipe}:")
    with _person(given) as person, watching(given, "DAgger") as begin:
        report = dagger(
            recipes,
            given.out,
            most_worlds=given.worlds,
            person=person,
            watched=begin,
            resume=given.resume,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    if given.json:
        return {"out": str(given.out), **report}
    rounds = {f"round {row['round']}": _line(row) for row in report.pop("rounds")}
    return {"out": str(given.out), **rounds, **report}


@contextmanager
def _person(given: Namespace) -> Iterator[Any]:
    """The expert, where it is a person."""
    if given.device is None:
        yield None
        return
    from lfd.experts.registry import open_device
    from lfd.loops.dagger_person import Person
    from lfd.terminal import StatusLine

    with open_device(given.device) as device, live_view(not given.no_view) as view, closing(StatusLine()) as status:
        yield Person(device=device, view=view, status=status)


def _line(row: Result) -> str:
    """A round in one line."""
    success = f", success {row['success_rate']:.0%}" if "success_rate" in row else ""
    return (
        f"beta {row['beta']:.2g}, {row['labels_total']} labels, {row['expert_steps']} steps by the expert, "
        f"{row['gradient_steps']} gradient steps{success}"
    )
