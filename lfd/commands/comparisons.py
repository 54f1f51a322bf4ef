"""The command that asks which of two motions is better.

It imports its stage when it runs, so that `lfd --help` answers at once.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from lfd.commands.options import Commands, Result, count, output, overrides
from lfd.core.errors import InputError

CRITERIA = ("information_gain", "volume_removal", "expected_volume", "random")
"""Names of `lfd.loops.comparing`, which is imported when the command runs."""
ME, SIMULATED = "me", "simulated"
RULES = {"criterion": "information_gain", "rationality": 1.0, "batch": 1, "seed": 0}
"""What is decided once and kept by --resume, with its defaults."""


def add(commands: Commands) -> None:
    """The command of this module."""
    made = commands.add(
        "compare",
        run_compare,
        "learn a reward from a person's answers to `which of these two motions is better?`",
        "lfd compare datasets/cup_panda.toml --out outputs/preferred",
    )
    made.epilog += "\n         lfd compare outputs/cup --reward outputs/reward --out outputs/better --questions 10"
    made.add_argument(
        "pool", type=Path, metavar="RECIPE|RECORDINGS",
        help="what to choose from: a TOML file with a [plan] table (then plans for random weights in its first scene, "
        "and the demonstrator's), or recordings of plans, several in a scene",
    )  # fmt: skip
    made.add_argument(
        "--person", default=ME, metavar="me|simulated|FILE",
        help="who answers: you, at the terminal (default); someone with the recipe's weights; a file, one of a, b, e "
        "(about equal), u (undo), q (stop) a line",
    )  # fmt: skip
    made.add_argument("--questions", type=count, default=20, metavar="N", help="answers to stop after (default: 20)")
    made.add_argument("--criterion", choices=CRITERIA, help=f"which question is best (default: {RULES['criterion']})")
    made.add_argument(
        "--stop-below", type=float, default=0.05, metavar="BITS",
        help="what an answer costs: a question that would tell less is not asked any more (default: 0.05)",
    )  # fmt: skip
    made.add_argument(
        "--batch", type=count, metavar="N", help="questions that are chosen together, 1 to 12 (default: 1)"
    )
    made.add_argument(
        "--rationality", type=float, metavar="R",
        help="how sure people are: p(a) = 1/(1 + exp(-R (U_A - U_B))), U with the planner's prior (default: 1)",
    )  # fmt: skip
    made.add_argument("--reward", type=Path, metavar="OLD", help="a reward to begin with; its features are asked about")
    made.add_argument(
        "--features", type=lambda text: tuple(text.split(",")), metavar="A,B,C",
        help="names of features, separated by commas (default: those of the demonstrator, or of --reward)",
    )  # fmt: skip
    made.add_argument("--plans", type=count, default=60, metavar="N", help="plans of a recipe's pool (default: 60)")
    made.add_argument(
        "--seed", type=int, metavar="S", help="seed of plans, questions and simulated answers (default: 0)"
    )
    made.add_argument("--resume", action="store_true", help="go on with the comparison in --out")
    made.add_argument("--viewer", action="store_true", help="also open each question in Rerun's viewer")
    output(made, "the reward")
    overrides(made)


def run_compare(given: Namespace) -> Result:
    """A reward from comparisons."""
    from lfd.loops.comparing import ask
    from lfd.loops.comparison_people import FromFile
    from lfd.loops.comparison_result import shown
    from lfd.loops.comparison_session import finish

    if given.person not in (ME, SIMULATED):
        FromFile(Path(given.person), taken=0)  # before the pool is made: it takes a while
    folder = (_resumed if given.resume else _begun)(given)
    comparison = folder.comparison
    person, truth = _person(given, folder)

    def save(_: Any) -> None:
        folder.replies += 1
        folder.save()

    ended = ask(comparison, person, questions=given.questions, stop_below=given.stop_below, save=save, tell=_tell)
    found = finish(folder, ended=ended, truth=truth)
    return {"out": str(given.out), **(found if given.json else shown(found))}


def _begun(given: Namespace) -> Any:
    """The folder of a new comparison."""
    from lfd.core.artifact import check_output
    from lfd.loops.comparing import Rules
    from lfd.loops.comparison_session import begin
    from lfd.terminal import progress_bar

    check_output(given.out, overwrite=given.overwrite)
    chosen = {key: getattr(given, key) for key in RULES if getattr(given, key) is not None}
    return begin(
        given.out,
        given.pool,
        Rules(**{**RULES, **chosen}),
        features=given.features,
        plans=given.plans,
        reward=given.reward,
        overrides=given.set,
        overwrite=given.overwrite,
        progress=progress_bar,
    )


def _resumed(given: Namespace) -> Any:
    """The folder of a comparison that goes on. Raises `InputError` for options that would make it another one."""
    from lfd.loops.comparison_folder import resumed

    folder = resumed(given.out)
    for key in RULES:
        kept, wanted = getattr(folder.comparison.rules, key), getattr(given, key)
        if wanted not in (None, kept):
            raise InputError(f"--{key} {wanted}: the comparison in {given.out} was begun with {kept}; leave it out")
    for key in ("reward", "features", "set"):
        if getattr(given, key):
            raise InputError(f"--{key} is decided when a comparison begins; leave it out, or choose another --out")
    if str(given.pool) not in folder.parents:
        raise InputError(f"the comparison in {given.out} is about {', '.join(folder.parents)}, not {given.pool}")
    return folder


def _person(given: Namespace, folder: Any) -> tuple[Any, Any]:
    """Who answers, and their weights of the features that are asked about, if those are known."""
    import numpy as np

    from lfd.loops.comparison_people import AtTerminal, FromFile, Simulated
    from lfd.loops.comparison_pictures import question_clip
    from lfd.replay.rerun_scene import replay

    pool, rules = folder.comparison.pool, folder.comparison.rules
    if given.person == SIMULATED:
        known = dict(zip(pool.recipe.features, pool.recipe.weights, strict=True))
        truth = np.array([known.get(name, 0.0) for name in pool.features])
        return Simulated(pool, rationality=rules.rationality, seed=rules.seed), truth
    if given.person != ME:
        return FromFile(Path(given.person), taken=folder.replies), None

    def show(question: Any) -> str:
        clip, shapes = question_clip(pool, question)
        file = given.out / f"question_{question.number + 1:03}.rrd"
        replay(clip, save=file, overwrite=True, shapes=shapes)
        if given.viewer:
            replay(clip, save=None, shapes=shapes)
        return f"first A, blue, then B, orange; look with: rerun {file}"

    return AtTerminal(show), None


def _tell(sentence: str) -> None:
    import sys

    print(sentence, file=sys.stderr)
