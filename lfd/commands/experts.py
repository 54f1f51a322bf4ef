"""The command that measures the scripted experts."""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

from lfd.commands.options import ALL_WORLDS, Commands, Result, count

ROBOTS = ("panda", "ur5e", "sawyer", "iiwa", "kinova3", "jaco")


def add(commands: Commands) -> None:
    """The command of this module."""
    made = commands.add(
        "experts",
        run_experts,
        "measure how often the scripted experts succeed: a table of tasks and robots, with 95%% Wilson intervals",
        "lfd experts --task Lift --task Stack --robot panda --episodes 200",
    )
    made.add_argument(
        "--task", action="append", metavar="TASK", help="task; may be repeated (default: all with an expert)"
    )
    made.add_argument(
        "--robot", action="append", metavar="ROBOT", help=f"robot; may be repeated (default: {', '.join(ROBOTS)})"
    )
    made.add_argument("--episodes", type=count, default=20, metavar="N", help="start states for each (default: 20)")
    made.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the start states (default: 0)")
    made.add_argument(
        "--seconds",
        type=float,
        default=25.0,
        metavar="T",
        help="simulated time after which it has failed (default: 25)",
    )
    made.add_argument(
        "--worlds",
        type=count,
        default=ALL_WORLDS,
        metavar="N",
        help="worlds in parallel at the most (default: one a core)",
    )
    made.add_argument(
        "--results", type=Path, metavar="PAGE.md", help="also write the table into a section of this page"
    )


def run_experts(given: Namespace) -> Result:
    """Success of experts."""
    from lfd.experts.registry import EXPERTS
    from lfd.loops.results import write_section
    from lfd.run.expert_success import ExpertTrial, expert_success
    from lfd.terminal import progress_bar

    trial = ExpertTrial(
        episodes=given.episodes,
        seed=given.seed,
        control_hz=20,
        max_seconds=given.seconds,
        hold_seconds=0.5,
        most_worlds=given.worlds,
    )
    table = expert_success(given.task or sorted(EXPERTS), given.robot or list(ROBOTS), trial, progress_bar)
    rows = {f"{task} {robot}": str(found) for task, row in table.items() for robot, found in row.items()}
    if given.results is not None:
        chosen = "".join(f" --task {task}" for task in given.task or ()) + "".join(
            f" --robot {robot}" for robot in given.robot or ()
        )
        command = f"lfd experts{chosen} --episodes {given.episodes} --seed {given.seed}"
        write_section(given.results, "Scripted experts", command, rows)
    if given.json:
        return {task: {robot: asdict(found) for robot, found in row.items()} for task, row in table.items()}
    return rows
