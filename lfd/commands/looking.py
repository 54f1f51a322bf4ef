"""Commands that show: episodes, facts, the machine, speed, the whole thread.

Every command imports its stage when it runs, so that `lfd --help` answers at once.
"""

import sys
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lfd.commands.options import Commands, Result, output
from lfd.core.errors import InputError


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
        "show episodes in Rerun: the arm in 3-D, cameras, actions, rewards, beliefs and weights on one time line",
        "lfd replay outputs/run --episode 3 --save rollout.rrd",
    )
    made.epilog += (
        "\n         lfd replay outputs/run --all --serve                      a list to step through, in a browser"
        "\n         lfd replay outputs/run --episodes 0,3,7 --beside          side by side"
        "\n         lfd replay outputs/dagger --round 2 --all                 who acted in a round of DAgger"
        "\n         lfd replay outputs/preferred --episode 4                  A and B of a question of `lfd compare`"
    )
    made.add_argument(
        "source", type=Path, metavar="PATH",
        help="recording, folder of recordings, LeRobot v3 dataset (any project's), evaluation, DAgger run, correction, "
        "comparison, interaction or plans",
    )  # fmt: skip
    which = made.add_mutually_exclusive_group()
    which.add_argument("--episode", type=int, metavar="I", help="number of one episode or question (default: 0)")
    which.add_argument("--episodes", metavar="0,3,7-9", help="numbers of several: a list to step through")
    which.add_argument("--all", action="store_true", help="all of them: a list to step through")
    which.add_argument("--list", action="store_true", help="instead of showing, say what there is, and how it ended")
    made.add_argument("--beside", action="store_true", help="several side by side instead of as a list")
    made.add_argument("--round", type=int, metavar="N", help="of a DAgger run the episodes of this round only")
    where = made.add_mutually_exclusive_group()
    where.add_argument("--save", type=Path, metavar="X.rrd", help="write a Rerun file instead of opening the viewer")
    where.add_argument(
        "--serve", action="store_true",
        help="show it in a browser on this machine (127.0.0.1 only, no internet needed) until Ctrl-C",
    )  # fmt: skip
    made.add_argument("--overwrite", action="store_true", help="replace the file of --save if it exists")
    made.add_argument(
        "--verify", action="store_true",
        help="instead of showing, execute the actions again and report the largest deviation; exit code 1 unless 0",
    )  # fmt: skip


MOST_BESIDE = 12
"""Episodes side by side: more would be too small to be seen."""
WORDS = {True: "solved", False: "not solved", None: ""}
"""For how an episode ended; nothing where nobody says so."""


def run_replay(given: Namespace) -> Result:
    """Episodes in Rerun, or the exact replay of one."""
    if given.verify:
        return _verified(given)
    from lfd.loops.replaying import listing
    from lfd.replay.listing import numbers_of
    from lfd.replay.rerun_scene.outputs import check_save, serve, show_in_window, write_file
    from lfd.replay.viewer_process import check_screen

    there = listing(given.source, given.round)
    if given.list:
        return _listed(there, as_json=given.json)
    if given.save is not None:
        check_save(given.save, overwrite=given.overwrite)
    elif not given.serve:
        check_screen()
    numbers = None if given.all else (given.episode or 0,) if given.episodes is None else numbers_of(given.episodes)
    entries = there.chosen(numbers)
    shown: Result = {}
    sheets = _sheets(entries, shown, beside=given.beside)
    if given.save is not None:
        write_file(sheets, given.save, overwrite=given.overwrite)
        return shown | {"saved": str(given.save), "bytes": given.save.stat().st_size}
    if given.serve:
        return shown | {"served": serve(sheets, _tell_address)}
    show_in_window(sheets)
    return shown | {"viewer": "opened"}


def _verified(given: Namespace) -> Result:
    """The exact replay of a recording."""
    from lfd.replay.verify import verify_replay

    if given.episodes is not None or given.all or given.list:
        raise InputError("--verify executes one episode: choose it with --episode I")
    found = asdict(verify_replay(given.source, given.episode or 0))
    found["failed"] = found["deviation"] > 0
    return found


def _listed(there: Any, *, as_json: bool) -> Result:
    """What there is, one line each."""
    rows = [
        {"episode": number, "title": entry.title, "success": entry.succeeded()}
        for number, entry in enumerate(there.entries)
    ]
    if as_json:
        return {"kind": there.kind, "episodes": rows}
    return {"lines": [f"{row['episode']:4}  {row['title']}  {WORDS[row['success']]}".rstrip() for row in rows]}


def _sheets(entries: Mapping[int, Any], shown: Result, *, beside: bool) -> Iterator[Any]:
    """What is seen at a time, read one after the other; `shown` is told what it was."""
    from lfd.replay.rerun_scene.outputs import Sheet

    if not beside:
        for number, entry in entries.items():
            clips = entry.open()
            _note(shown, entry.title, clips)
            told = WORDS[clips[0].success] if len(clips) == 1 else ""  # first, since the viewer's list is narrow
            yield Sheet(f"{number}: {told + ', ' * bool(told)}{entry.title}", clips, listed=len(entries) > 1)
        return
    clips = tuple(clip for entry in entries.values() for clip in entry.open())
    if not 2 <= len(clips) <= MOST_BESIDE:
        raise InputError(
            f"--beside puts 2 to {MOST_BESIDE} episodes side by side, not {len(clips)}: choose with --episodes 0,3,7"
        )
    _note(shown, ", ".join(entry.title for entry in entries.values()), clips)
    yield Sheet(f"{len(clips)} side by side", clips)


def _note(shown: Result, title: str, clips: Sequence[Any]) -> None:
    """Add what a sheet shows to the result."""
    shown["episode"] = f"{shown['episode']}, {title}" if "episode" in shown else title
    shown["seconds"] = shown.get("seconds", 0.0) + max(float(clip.times[-1]) for clip in clips)


def _tell_address(address: str) -> None:
    print(
        f"look at {address}\n(over SSH: forward both ports, see docs/replay.md; Ctrl-C ends it)",
        file=sys.stderr,
        flush=True,
    )


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
    "replay",
    "console",
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
        "with either gradient), replay (faster than real time, sizes of Rerun files, what --live costs), "
        "console (how late it is, memory over half an hour of reconnects)",
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
    from lfd.core.artifact import commit
    from lfd.loops.results import write_section

    commit()  # remembered: of the code that runs, before its pictures change the checkout
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
