"""The command with which a person corrects an arm by pushing it.

It imports its stage when it runs, so that `lfd --help` answers at once.
"""

import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from lfd.commands.demonstrations import live_view
from lfd.commands.options import Commands, Result, count, output, short
from lfd.core.errors import InputError

CORRECTION_TASKS = ("cup", "table", "laptop", "person")
"""Names of `lfd.loops.correction_tasks`, which is imported when the command runs."""
CORRECTION_RULES = ("one", "all", "confident")
RESPONSES = ("learn", "deform", "impedance")
SCRIPTED, DEVICE, CONSOLE = "scripted", "device", "console"
DEMONSTRATIONS = 10


def add(commands: Commands) -> None:
    """The command of this module."""
    made = commands.add(
        "correct",
        run_correct,
        "push an arm while it carries out its plan, and it learns what you care for",
        "lfd correct laptop --out outputs/corrected --save corrected.rrd",
    )
    made.epilog += "\n         lfd correct table --person device --device spacemouse --out outputs/mine"
    made.epilog += (
        "\n         lfd correct cup --person outputs/corrected/recordings/episode_000000.mcap --out outputs/again"
    )
    made.add_argument(
        "task", choices=CORRECTION_TASKS,
        help="what the robot does not know: that the cup should be upright, low over the table, not over the "
        "laptop, not near the person",
    )  # fmt: skip
    made.add_argument("--robot", default="panda", metavar="NAME", help="robot config (default: panda)")
    made.add_argument(
        "--person", default=SCRIPTED, metavar="scripted|device|console|FILE",
        help="who pushes: somebody scripted, who has weights of their own (default); you, with --device, or in a page "
        "of the browser by dragging the arm; the pushes of a recording, again",
    )  # fmt: skip
    made.add_argument(
        "--device", default="keyboard", metavar="DEVICE",
        help="with --person device: keyboard, spacemouse or gamepad; its deflection is the force (default: keyboard)",
    )  # fmt: skip
    made.add_argument("--no-view", action="store_true", help="with --person device: no live view of the robot")
    made.add_argument("--runs", type=count, default=2, metavar="N", help="ways from start to goal (default: 2)")
    made.add_argument(
        "--rule", choices=CORRECTION_RULES, default="one",
        help="how weights learn: the one feature that changed most, all, or all as far as features explain the push",
    )  # fmt: skip
    made.add_argument("--step", type=float, default=4.0, metavar="B", help="size of the update (default: 4)")
    made.add_argument(
        "--response", choices=RESPONSES, default="learn",
        help="what a push changes: the weights and the plan (learn), the plan (deform), or nothing (impedance)",
    )  # fmt: skip
    made.add_argument("--reward", type=Path, metavar="OLD", help="a reward to begin with, that `lfd correct` wrote")
    made.add_argument(
        "--dataset", type=Path, metavar="DIR",
        help="afterwards also carry out what was learned, undisturbed and with small deviations, and convert it to a "
        "dataset that policies can be trained on",
    )  # fmt: skip
    made.add_argument(
        "--demonstrations", type=count, metavar="N", help=f"of --dataset: how many (default: {DEMONSTRATIONS})"
    )
    made.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the scene, the person and noise")
    made.add_argument("--save", type=Path, metavar="X.rrd", help="also write the first run as a Rerun file")
    output(made, "the recordings and the reward")


def run_correct(given: Namespace) -> Result:
    """A reward from pushes."""
    from lfd.core.artifact import check_output, sha256
    from lfd.core.protocols import silent
    from lfd.loops.correcting import CorrectionRecipe, learner_of, set_up, start_reward
    from lfd.loops.correction_results import demonstrate_learned
    from lfd.loops.correction_session import correct_into
    from lfd.replay.clip import clip_of
    from lfd.replay.rerun_scene import replay
    from lfd.rewards.reward_artifact import load_reward
    from lfd.terminal import progress_bar

    check_output(given.out, overwrite=given.overwrite)
    if given.save is not None and given.save.exists() and not given.overwrite:
        raise InputError(f"{given.save} exists already; choose another --save, or add --overwrite to replace it")
    if given.dataset is None and given.demonstrations is not None:
        raise InputError("--demonstrations is for a dataset: name its folder with --dataset DIR")
    if given.dataset is not None:
        check_output(given.dataset, overwrite=given.overwrite)
    recipe = CorrectionRecipe(
        task=given.task, robot=given.robot, runs=given.runs, seed=given.seed, rule=given.rule, step=given.step,
        response=given.response,
    )  # fmt: skip
    recipe.check("lfd correct")
    reward = start_reward(recipe) if given.reward is None else load_reward(given.reward)
    learner_of(reward, recipe)  # a reward that does not fit shows before the scene is made
    setup = set_up(recipe)
    with _person(given, recipe, setup) as seat:
        report, learned = correct_into(
            given.out,
            recipe,
            setup,
            reward,
            seat,
            parents={} if given.reward is None else {str(given.reward): sha256(given.reward)},
            overwrite=given.overwrite,
            progress=silent if given.person == DEVICE else progress_bar,  # its person's line says how far they are
        )
    if given.save is not None:
        clip = clip_of(given.out / "recordings", 0)
        replay(clip, save=given.save, overwrite=given.overwrite, shapes=setup.planner.scene.shapes)
        report["saved"] = str(given.save)
    if given.dataset is not None:
        report["dataset"] = demonstrate_learned(
            recipe, learned, given.dataset, given.demonstrations or DEMONSTRATIONS,
            overwrite=given.overwrite, progress=progress_bar,
        )  # fmt: skip
    return {"out": str(given.out), **(report if given.json else _shown(report))}


@contextmanager
def _person(given: Namespace, recipe: Any, setup: Any) -> Iterator[Any]:
    """Who pushes."""
    from lfd.loops.correcting import scripted
    from lfd.loops.correction_results import recorded_person
    from lfd.loops.correction_session import Seat

    if given.person == SCRIPTED:
        yield Seat(scripted(recipe, setup), has_known_weights=True)
    elif given.person == DEVICE:
        from lfd.experts.pushing import DevicePerson
        from lfd.experts.registry import open_device
        from lfd.loops.correction_results import Watching
        from lfd.record.pacing import Paced
        from lfd.terminal import StatusLine
        from lfd.worlds.robots import load_model, load_teleop

        with open_device(given.device) as device, live_view(not given.no_view) as view, closing(StatusLine()) as status:
            person = DevicePerson(device, load_teleop(recipe.robot).frame, load_model(recipe.robot).push_n)
            yield Seat(
                person,
                observers=lambda: [Watching(view, status, device)],
                around=lambda policy: Paced(policy, recipe.control_hz),
            )
    elif given.person == CONSOLE:
        from lfd.console.console import console
        from lfd.console.correct import add_pushing, seat_at
        from lfd.console.serving import free_port

        with console(given.out.parent, port=free_port(), modes={}) as running:
            plot = add_pushing(running.page, recipe.task)
            print(f"push the arm at {running.url}", file=sys.stderr, flush=True)
            with seat_at(running.page, plot, recipe, setup) as seat:
                yield seat
    else:
        yield Seat(recorded_person(Path(given.person)))


def _shown(report: Result) -> Result:
    """A report as lines of a table."""
    told = dict(report)
    steps = told.pop("weights")
    for name in steps[0]:
        told[name] = " -> ".join(f"{row[name]:.3g}" for row in steps)
    for key in ("regret", "cosine"):
        if key in told:
            told[key] = f"{short(told[key])}, before and after each push"
    return told
