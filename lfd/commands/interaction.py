"""The command that puts robots among people.

It imports its stage when it runs, so that `lfd --help` answers at once.
"""

from argparse import Namespace
from pathlib import Path

from lfd.commands.options import Commands, Result, count, output

SCENES = ("merge", "crossing", "shared_table")
KINDS = ("obstacle", "known", "passive", "active")
"""Names of `lfd.interaction.scenes` and of the robots, imported when it runs."""


def add(commands: Commands) -> None:
    """The commands of this module."""
    made = commands.add(
        "interact",
        run_interact,
        "act among people who answer to what the robot does: as if they were obstacles, known, inferred, or asked",
        "lfd interact merge --robot-kind obstacle active --episodes 10 --out outputs/merge",
    )
    made.epilog += "\n         lfd replay outputs/merge/active --episode 3 --save merge.rrd"
    made.add_argument(
        "scene", choices=SCENES, metavar="SCENE",
        help="merge (change lanes before or behind a car), crossing (a car comes from the right), shared_table (an arm "
        "and a person's hand reach for one of three cubes)",
    )  # fmt: skip
    made.add_argument(
        "--robot-kind", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND",
        help="obstacle (people keep their velocity), known (people of the type --assumed), passive (infers the type "
        "from what it sees), active (acts so as to see it); one or more (default: all four)",
    )  # fmt: skip
    made.add_argument(
        "--assumed", default=None, metavar="TYPE",
        help="type that `known` takes people for: aggressive or passive on the road, CUBE-MANNER at the table, such as "
        "left-yields (default: aggressive, middle-insists)",
    )  # fmt: skip
    made.add_argument(
        "--person", default="random", metavar="WHO",
        help="people that are met: of one type, at the table also of one manner (yields, insists), or random, any type "
        "with the same probability (default: random)",
    )  # fmt: skip
    made.add_argument(
        "--person-reward", nargs="+", type=Path, default=[], metavar="REWARD",
        help="what robots take people of a type to be after, as `lfd irl people` learned it, one for a "
        "type (default: weights that lfd comes with)",
    )  # fmt: skip
    made.add_argument("--episodes", type=count, default=10, metavar="N", help="episodes of each robot (default: 10)")
    made.add_argument("--seed", type=int, default=0, metavar="S", help="seed of starts and people (default: 0)")
    output(made, "recordings, the report and a picture of the belief's entropy")


def run_interact(given: Namespace) -> Result:
    """Robots among people."""
    from lfd.core.artifact import sha256
    from lfd.interaction.person_reward import load_person_reward, theta_of
    from lfd.interaction.scenes import scene_of
    from lfd.loops.interacting import InteractRecipe, interact, told
    from lfd.terminal import progress_bar

    scene, learned = scene_of(given.scene), {}
    if given.person_reward:
        rewards = [load_person_reward(folder) for folder in given.person_reward]
        learned["learned"] = theta_of(rewards, scene.options.rationality)
    robots = scene.robots(given.robot_kind, given.assumed, **learned)
    recipe = InteractRecipe(
        scene=given.scene, robots=robots, person=given.person, episodes=given.episodes, seed=given.seed
    )
    parents = {str(folder): sha256(folder) for folder in given.person_reward}
    report = interact(recipe, given.out, parents=parents, overwrite=given.overwrite, progress=progress_bar)
    if given.json:
        return {"out": str(given.out), "robots": report}
    return {"out": str(given.out), **{name: told(of) for name, of in report.items()}}
