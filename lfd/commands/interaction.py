"""The command that puts robots among people.

It imports its stage when it runs, so that `lfd --help` answers at once.
"""

from argparse import Namespace

from lfd.commands.options import Commands, Result, count, output

SCENES = ("merge", "crossing")
KINDS = ("obstacle", "known", "passive", "active")
TYPES = ("aggressive", "passive")
"""Names of `lfd.worlds.driving_world`, `lfd.interaction.driving_robots` and `driving_model`, imported when it runs."""


def add(commands: Commands) -> None:
    """The commands of this module."""
    made = commands.add(
        "interact",
        run_interact,
        "drive among people who answer to what the robot does: as if they were obstacles, known, inferred, or asked",
        "lfd interact merge --robot-kind obstacle active --episodes 10 --out outputs/merge",
    )
    made.epilog += "\n         lfd replay outputs/merge/active --episode 3 --save merge.rrd"
    made.add_argument(
        "scene", choices=SCENES, metavar="SCENE",
        help="merge (change lanes before or behind a car), crossing (a car comes from the right)",
    )  # fmt: skip
    made.add_argument(
        "--robot-kind", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND",
        help="obstacle (people keep their speed), known (people of the type --assumed), passive (infers the type from "
        "what it sees), active (acts so as to see it); one or more (default: all four)",
    )  # fmt: skip
    made.add_argument(
        "--assumed",
        choices=TYPES,
        default="aggressive",
        help="type that `known` takes people for (default: aggressive)",
    )
    made.add_argument(
        "--person", choices=(*TYPES, "random"), default="random",
        help="people that are met: of one type, or of either with the same probability (default: random)",
    )  # fmt: skip
    made.add_argument("--episodes", type=count, default=10, metavar="N", help="episodes of each robot (default: 10)")
    made.add_argument("--seed", type=int, default=0, metavar="S", help="seed of starts and people (default: 0)")
    output(made, "recordings, the report and a picture of the belief's entropy")


def run_interact(given: Namespace) -> Result:
    """Robots among people."""
    from lfd.interaction.driving_robots import DriverOptions
    from lfd.loops.interacting import InteractRecipe, interact, told
    from lfd.terminal import progress_bar

    robots = tuple(DriverOptions(kind=kind, assumed=given.assumed) for kind in given.robot_kind)
    recipe = InteractRecipe(
        scene=given.scene, robots=robots, person=given.person, episodes=given.episodes, seed=given.seed
    )
    report = interact(recipe, given.out, overwrite=given.overwrite, progress=progress_bar)
    if given.json:
        return {"out": str(given.out), "robots": report}
    return {"out": str(given.out), **{name: told(of) for name, of in report.items()}}
