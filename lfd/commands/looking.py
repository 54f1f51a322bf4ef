"""Commands that show: episodes, facts, the machine, speed, the whole thread.

Every command imports its stage when it runs, so that `lfd --help` answers at once.
"""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

from lfd.commands.options import Commands, Result, output


def add(commands: Commands) -> None:
    """The commands of this module."""
    _replay(commands)
    _info(commands)
    _doctor(commands)
    _bench(commands)
    _demo(commands)


def _replay(commands: Commands) -> None:
    made = commands.add(
        "replay",
        run_replay,
        "show an episode in Rerun: the arm in 3-D, actions and joints as plots",
        "lfd replay outputs/run --episode 3 --save rollout.rrd",
    )
    made.add_argument(
        "source", type=Path, metavar="FILE|DATASET|RUN", help="recording, folder of recordings, dataset or evaluation"
    )
    made.add_argument("--episode", type=int, default=0, metavar="I", help="episode of a folder (default: 0)")
    made.add_argument("--save", type=Path, metavar="X.rrd", help="write a Rerun file instead of opening the viewer")
    made.add_argument("--overwrite", action="store_true", help="replace the file of --save if it exists")
    made.add_argument(
        "--verify", action="store_true",
        help="instead of showing, execute the actions again and report the largest deviation; exit code 1 unless 0",
    )  # fmt: skip


def run_replay(given: Namespace) -> Result:
    """An episode in Rerun, or its exact replay."""
    from lfd.replay.clip import clip_of
    from lfd.replay.rerun_scene import replay
    from lfd.replay.verify import verify_replay

    if given.verify:
        found = asdict(verify_replay(given.source, given.episode))
        found["failed"] = found["deviation"] > 0
        return found
    clip = clip_of(given.source, given.episode)
    replay(clip, save=given.save, overwrite=given.overwrite)
    shown = {"saved": str(given.save), "bytes": given.save.stat().st_size} if given.save else {"viewer": "opened"}
    return {"episode": clip.title, "seconds": float(clip.times[-1]), **shown}


def _info(commands: Commands) -> None:
    made = commands.add(
        "info",
        run_info,
        "say what a recording, dataset, policy, evaluation or recipe holds",
        "lfd info outputs/recordings/episode_000000.mcap",
    )
    made.add_argument("path", type=Path, metavar="PATH", help="file or folder")


def run_info(given: Namespace) -> Result:
    """What a file or folder holds."""
    from lfd.about import about

    return about(given.path)


def _doctor(commands: Commands) -> None:
    commands.add("doctor", run_doctor, "say what of this machine works", "lfd doctor")


def run_doctor(given: Namespace) -> Result:
    """What of this machine works."""
    del given
    from lfd.doctor import examine

    checks = examine()
    marks = {c.name: f"{'ok' if c.works else 'BROKEN' if c.needed else 'no'}: {c.detail}" for c in checks}
    return {**marks, "failed": any(c.needed and not c.works for c in checks)}


SUITES = (
    "sim",
    "cameras",
    "record",
    "convert",
    "train",
    "compounding",
    "dagger",
    "comparisons",
    "irl",
    "corrections",
    "interaction",
)
"""Names of `lfd.bench.suites`, which is imported when one runs."""


def _bench(commands: Commands) -> None:
    made = commands.add(
        "bench",
        run_bench,
        "measure side by side: sim (robosuite's step, ours, the physics alone), cameras (robosuite's, ours), record "
        "(with and without, writers, real time), convert (LeRobot's calls, ours), train (loading and gradient steps: "
        "LeRobot, robomimic, imitation, ours), compounding (errors against the horizon), dagger (success by labels), "
        "comparisons (alignment by answers), irl (three methods by demonstrations, imitation), "
        "corrections (what pushes teach, how soon they are noticed), interaction (four robots among people, planning "
        "with either gradient)",
        "lfd bench sim --quick",
    )
    made.add_argument("suite", choices=SUITES, help="what to measure")
    made.add_argument("--quick", action="store_true", help="a tenth of the steps")
    made.add_argument(
        "--full", action="store_true",
        help="sim: also every task and robot, success on both steppers, and the numbers of every robot x controller x "
        "task; takes ten minutes",
    )  # fmt: skip
    made.add_argument(
        "--results", type=Path, metavar="PAGE.md", help="also write the table into a section of this page"
    )
    made.add_argument("--task", default="Lift", help="default: Lift")
    made.add_argument("--robot", default="panda", help="default: panda")
    made.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the start states (default: 0)")


def run_bench(given: Namespace) -> Result:
    """Speed, side by side."""
    from lfd.bench.suites import SUITES
    from lfd.loops.results import write_section

    measured, sections = SUITES[given.suite](given)
    if given.results is not None:
        command = f"lfd bench {given.suite}" + " --quick" * given.quick + " --full" * given.full
        for title, rows in sections.items():
            write_section(given.results, title, command, rows)
    if given.json:
        return measured
    return {f"{title}: {name}": value for title, rows in sections.items() for name, value in rows.items()}


def _demo(commands: Commands) -> None:
    made = commands.add(
        "demo",
        run_demo,
        "record, convert, train, evaluate and replay: the whole thread on Lift with a Panda",
        "lfd demo --out outputs/demo",
    )
    made.add_argument(
        "--dataset-recipe", type=Path, default=Path("datasets/lift_panda.toml"), metavar="RECIPE",
        help="default: datasets/lift_panda.toml",
    )  # fmt: skip
    made.add_argument(
        "--policy-recipe", type=Path, default=Path("policies/bc_mlp.toml"), metavar="RECIPE",
        help="default: policies/bc_mlp.toml",
    )  # fmt: skip
    made.add_argument(
        "--results", type=Path, metavar="PAGE.md", help="also write the table into a section of this page"
    )
    output(made, "everything that the stages make")


def run_demo(given: Namespace) -> Result:
    """The whole thread at once."""
    from lfd.loops.demo import demo, rows_of
    from lfd.loops.results import write_section
    from lfd.terminal import progress_bar

    recipes = given.dataset_recipe, given.policy_recipe
    measured = demo(*recipes, given.out, overwrite=given.overwrite, progress=progress_bar)
    if given.results is not None:
        write_section(given.results, "The thread on Lift with a Panda", "lfd demo", rows_of(measured))
    return measured if given.json else dict(rows_of(measured))
