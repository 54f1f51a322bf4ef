"""The command line: arguments and help, what is printed, exit codes. What commands do is in `lfd.commands`."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lfd import commands
from lfd.commands import Result
from lfd.core.errors import InputError, LfdError
from lfd.experts.keys import HELP
from lfd.worlds.rendering import check_wish

PIPELINE = """\
the way from a demonstration to a policy:
  lfd record datasets/lift_panda.toml --out outputs/recordings     scripted demonstrations as MCAP files
  lfd convert outputs/recordings --out outputs/dataset             a LeRobot v3 dataset, verified
  lfd train policies/bc_mlp.toml --dataset outputs/dataset --out outputs/policy
  lfd eval outputs/policy --out outputs/run                        success rate with its interval
  lfd replay outputs/run --save rollout.rrd                        look at it in Rerun
or all of it: lfd demo
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 success, 2 the user's mistake, 1 anything else."""
    arguments = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], Result] = arguments.command
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    try:
        if command is not commands.run_doctor:
            check_wish()
        with _only_json_on_stdout(arguments.json) as out:
            result = command(arguments)
            failed = result.pop("failed", False)
            if arguments.json:
                out.write(json.dumps(result) + "\n")
            else:
                _show(arguments.name, result)
    except InputError as error:
        print(f"lfd {arguments.name}: {error}", file=sys.stderr)
        return 2
    except LfdError as error:
        print(f"lfd {arguments.name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        kept = {
            "record": "finished episodes are kept",
            "demo": "finished stages are kept",
            "sweep": "finished policies are kept",
            "recover": "what was recovered so far is kept",
        }
        print(
            f"\nlfd {arguments.name}: interrupted; {kept.get(arguments.name, 'nothing was written')}", file=sys.stderr
        )
        return 1
    return 1 if failed else 0


@contextmanager
def _only_json_on_stdout(wanted: bool) -> Iterator[Any]:
    """With --json, whatever the libraries print goes to standard error, also from C."""
    if not wanted:
        yield sys.stdout
        return
    sys.stdout.flush()
    real = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(os.dup(real), "w") as out:
            yield out
    finally:
        sys.stdout.flush()
        os.dup2(real, 1)
        os.close(real)


def _show(title: str, result: Result) -> None:
    from lfd.terminal import print_table

    if list(result) == ["lines"]:
        print(*result["lines"], sep="\n")
        return
    rows = {}
    for key, value in result.items():
        if isinstance(value, dict) and "meaning" in value:
            value = f"{value['value']}\n{value['meaning']}"
        elif isinstance(value, dict):
            value = ", ".join(f"{k} {v}" for k, v in value.items())
        elif isinstance(value, float):
            value = f"{value:.4g}"
        elif isinstance(value, (list, tuple)):
            value = ", ".join(f"{v:.3f}" if isinstance(v, float) else str(v) for v in value)
        rows[key] = value
    print_table(f"lfd {title}", rows)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 1")
    return int(text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lfd",
        description="Robot learning from demonstration: record, convert, train, run and replay.",
        epilog=PIPELINE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], Result], summary: str, example: str) -> Any:
        made = subparsers.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        made.set_defaults(command=run, name=name)
        made.add_argument("--json", action="store_true", help="print the result as one JSON object on standard output")
        return made

    def output(made: Any, what: str) -> None:
        made.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"folder for {what}")
        made.add_argument("--overwrite", action="store_true", help="replace the folder if it exists")

    def overrides(made: Any) -> None:
        made.add_argument(
            "--set", action="append", default=[], metavar="TABLE.KEY=VALUE",
            help="override any key of the recipe; `lfd info RECIPE` lists them; may be repeated",
        )  # fmt: skip

    def cluster(made: Any) -> None:
        made.add_argument(
            "--cluster", nargs="?", const="local", metavar="ADDRESS",
            help="run on Ray, with the same result: `local` (also without an address) starts it on this machine, "
            "`auto` joins the one that runs here, ray://HOST:10001 another; needs pip install 'lfd[cluster]'",
        )  # fmt: skip

    def parallel(made: Any) -> None:
        made.add_argument(
            "--worlds", type=_count, default=commands.ALL_WORLDS, metavar="N",
            help="worlds to run in parallel at the most; the result is the same (default: one a core)",
        )  # fmt: skip
        cluster(made)

    made = command(
        "record",
        commands.run_record,
        "record demonstrations of a task into MCAP files, one an episode",
        "lfd record datasets/lift_panda.toml --episodes 50 --out outputs/recordings",
    )
    made.add_argument("recipe", type=Path, metavar="RECIPE", help="dataset recipe, a TOML file with a [record] table")
    made.add_argument("--episodes", type=int, metavar="N", help="successful demonstrations to record")
    made.add_argument("--seed", type=int, metavar="S", help="seed of start states and noise")
    made.add_argument(
        "--device", metavar="DEVICE",
        help="you demonstrate, with keyboard, spacemouse or gamepad, instead of the scripted expert; keys are below",
    )  # fmt: skip
    made.add_argument("--no-view", action="store_true", help="with --device: no live view of the robot")
    made.add_argument("--resume", action="store_true", help="go on with the recordings of the folder")
    made.epilog += f"\n         lfd record datasets/lift_panda.toml --device keyboard --out outputs/mine\n\n{HELP}"
    parallel(made)
    output(made, "the recordings")
    overrides(made)

    made = command(
        "convert",
        commands.run_convert,
        "convert recordings into a LeRobot v3 dataset and verify it by reading both back",
        "lfd convert outputs/recordings --out outputs/dataset",
    )
    made.add_argument(
        "sources", type=Path, nargs="+", metavar="FILE|DIR",
        help="recordings of lfd, MCAP files of other programs, ROS 2 bags, robosuite's or robomimic's HDF5 files, or "
        "folders of them",
    )  # fmt: skip
    made.add_argument(
        "--recipe", type=Path, metavar="RECIPE",
        help="dataset recipe: its [convert] table says what becomes what (default: the one kept in the recordings), "
        "[resample] and [map.NAME] do for files of other programs, [video] how pictures are kept",
    )  # fmt: skip
    made.add_argument("--append", action="store_true", help="add the episodes to the dataset that is there")
    made.add_argument(
        "--skip-bad",
        action="store_true",
        help="leave out recordings that cannot be used, and list them, instead of ending",
    )
    made.add_argument(
        "--trust-rows", action="store_true", help="in HDF5 files whose own counts differ from their rows, take the rows"
    )
    made.add_argument("--jobs", type=_count, metavar="N", help="processes that read (default: what is worth it)")
    cluster(made)
    output(made, "the dataset")

    made = command(
        "verify",
        commands.run_verify,
        "compare every number, task, unit and boundary of a dataset with its sources",
        "lfd verify outputs/dataset outputs/recordings",
    )
    made.add_argument("dataset", type=Path, metavar="DATASET", help="LeRobot dataset folder")
    made.add_argument("sources", type=Path, nargs="+", metavar="FILE|DIR", help="what it was converted from, in order")
    made.add_argument(
        "--recipe",
        type=Path,
        metavar="RECIPE",
        help="recipe of the conversion (default: the one that the dataset keeps)",
    )

    made = command(
        "export",
        commands.run_export,
        "write episodes as MCAP files, or as an HDF5 file on which robomimic trains",
        "lfd export outputs/recordings --to robomimic --out outputs/demos.hdf5",
    )
    made.add_argument(
        "sources", type=Path, nargs="+", metavar="FILE|DIR|DATASET",
        help="one LeRobot dataset, or recordings, HDF5 demonstrations, or folders of them",
    )  # fmt: skip
    made.add_argument("--to", required=True, choices=["mcap", "robomimic"], help="format")
    made.add_argument(
        "--seed", type=int, default=0, metavar="S", help="robomimic: draws the tenth for validation (default: 0)"
    )
    made.add_argument(
        "--trust-rows", action="store_true", help="in HDF5 files whose own counts differ from their rows, take the rows"
    )
    output(made, "the MCAP files, or the HDF5 file")

    made = command(
        "trace",
        commands.run_trace,
        "print the chain policy, dataset, recordings, and whether each is still what it was",
        "lfd trace outputs/policy",
    )
    made.add_argument("path", type=Path, metavar="PATH", help="folder of a dataset, policy, evaluation or export")

    made = command(
        "recover",
        commands.run_recover,
        "make episodes of what a crash left, and of damaged recordings what is whole of them",
        "lfd recover outputs/recordings",
    )
    made.add_argument("folder", type=Path, metavar="DIR", help="folder of recordings")

    made = command(
        "train",
        commands.run_train,
        "train a policy on a dataset by behaviour cloning",
        "lfd train policies/bc_mlp.toml --dataset outputs/dataset --out outputs/policy",
    )
    made.add_argument("recipe", type=Path, metavar="RECIPE", help="policy recipe: [policy], [train] and [eval] tables")
    made.add_argument("--dataset", type=Path, required=True, metavar="DATASET", help="LeRobot dataset folder")
    made.add_argument("--steps", type=int, metavar="N", help="gradient steps")
    made.add_argument("--seed", type=int, metavar="S", help="seed of weights and batches")
    output(made, "the policy")
    overrides(made)

    made = command(
        "eval",
        commands.run_evaluate,
        "run a policy from unseen start states: success rate with a 95%% Wilson interval",
        "lfd eval outputs/policy --episodes 50 --out outputs/run",
    )
    made.add_argument("policy", type=Path, metavar="POLICY", help="policy folder made by `lfd train`")
    made.add_argument("--episodes", type=int, metavar="N", help="start states to try")
    made.add_argument("--seed", type=int, metavar="S", help="seed of the start states")
    parallel(made)
    output(made, "the report and the recordings of all episodes")

    made = command(
        "sweep",
        commands.run_sweep,
        "train and evaluate a policy for every combination of some values of a recipe",
        "lfd sweep policies/bc_mlp.toml --dataset outputs/dataset --vary train.seed=[0,1,2] --out outputs/sweep",
    )
    made.add_argument("recipe", type=Path, metavar="RECIPE", help="policy recipe: [policy], [train] and [eval] tables")
    made.add_argument("--dataset", type=Path, required=True, metavar="DATASET", help="LeRobot dataset folder")
    made.add_argument(
        "--vary", action="append", required=True, metavar="TABLE.KEY=[VALUE,VALUE]",
        help="values to try for a key of the recipe; may be repeated, all combinations are made",
    )  # fmt: skip
    cluster(made)
    output(made, "the policies and their evaluations")

    made = command(
        "replay",
        commands.run_replay,
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

    made = command(
        "info",
        commands.run_info,
        "say what a recording, dataset, policy, evaluation or recipe holds",
        "lfd info outputs/recordings/episode_000000.mcap",
    )
    made.add_argument("path", type=Path, metavar="PATH", help="file or folder")

    command("doctor", commands.run_doctor, "say what of this machine works", "lfd doctor")

    made = command(
        "bench",
        commands.run_bench,
        "measure speed side by side: sim (robosuite's step, ours, the physics alone), cameras (robosuite's, ours), "
        "record (with and without, writers, real time) or convert (LeRobot's calls, ours)",
        "lfd bench sim --quick",
    )
    made.add_argument("suite", choices=["sim", "cameras", "record", "convert"], help="what to measure")
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

    made = command(
        "demo",
        commands.run_demo,
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
    return parser


if __name__ == "__main__":
    sys.exit(main())
