"""The command line. Every command imports its stage when it runs, so that `lfd --help` answers at once."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lfd.core.errors import InputError, LfdError
from lfd.worlds.rendering import check_wish

Result = dict[str, Any]
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
        if command is not _doctor:
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


def _record(given: argparse.Namespace) -> Result:
    from lfd.core.recipe import build, load_toml
    from lfd.record.demonstrations import RecordRecipe, record
    from lfd.terminal import progress_bar

    tables = load_toml(given.recipe, ("record", "convert"), given.set)
    _put(tables, "record", episodes=given.episodes, seed=given.seed)
    recipe = build(RecordRecipe, tables.get("record", {}), f"{given.recipe} [record]")
    with _machines(given.cluster) as cluster:
        done = record(
            recipe,
            given.out,
            tables=tables,
            most_worlds=given.worlds,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    return {"out": str(given.out), **asdict(done)}


def _convert(given: argparse.Namespace) -> Result:
    from lfd.convert.features import ConvertRecipe
    from lfd.convert.to_lerobot import convert
    from lfd.core.recipe import build, load_toml
    from lfd.terminal import progress_bar

    recipe = None
    if given.recipe is not None:
        table = load_toml(given.recipe, ("record", "convert")).get("convert", {})
        recipe = build(ConvertRecipe, table, f"{given.recipe} [convert]")
    done = convert(given.sources, given.out, recipe=recipe, overwrite=given.overwrite, progress=progress_bar)
    return {"out": str(given.out), **asdict(done)}


def _train(given: argparse.Namespace) -> Result:
    from lfd.core.recipe import build, load_toml
    from lfd.run.evaluate import EvalRecipe
    from lfd.terminal import progress_bar
    from lfd.train.behavior_cloning import TrainRecipe, train

    tables = load_toml(given.recipe, ("policy", "train", "eval"), given.set)
    _put(tables, "train", steps=given.steps, seed=given.seed)
    recipe = build(TrainRecipe, tables.get("train", {}), f"{given.recipe} [train]")
    build(EvalRecipe, tables.get("eval", {}), f"{given.recipe} [eval]")  # a mistake in it shows before training
    done = train(
        tables.get("policy", {}),
        recipe,
        given.dataset,
        given.out,
        tables=tables,
        overwrite=given.overwrite,
        progress=progress_bar,
    )
    return {"out": str(given.out), **asdict(done)}


def _eval(given: argparse.Namespace) -> Result:
    from lfd.core.recipe import build
    from lfd.policies.acting import about_policy
    from lfd.run.evaluate import EvalRecipe, evaluate
    from lfd.terminal import progress_bar

    tables = about_policy(given.policy)["recipe"]
    _put(tables, "eval", episodes=given.episodes, seed=given.seed)
    recipe = build(EvalRecipe, tables["eval"], f"{given.policy} [eval]")
    with _machines(given.cluster) as cluster:
        done = evaluate(
            given.policy,
            recipe,
            given.out,
            most_worlds=given.worlds,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    report = asdict(done)
    del report["per_episode"]
    return {"out": str(given.out), **report}


def _sweep(given: argparse.Namespace) -> Result:
    from lfd.loops.sweep import sweep
    from lfd.terminal import progress_bar

    with _machines(given.cluster) as cluster:
        rows = sweep(
            given.recipe,
            given.vary,
            given.dataset,
            given.out,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    if given.json:
        return {"out": str(given.out), "rows": rows}
    best = {row.pop("folder"): ", ".join(f"{k} {_short(v)}" for k, v in row.items()) for row in rows}
    return {"out": str(given.out), **best}


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(map(_short, value)) + "]"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _replay(given: argparse.Namespace) -> Result:
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


def _info(given: argparse.Namespace) -> Result:
    from lfd.about import about

    return about(given.path)


def _doctor(given: argparse.Namespace) -> Result:
    del given
    from lfd.doctor import examine

    checks = examine()
    marks = {c.name: f"{'ok' if c.works else 'BROKEN' if c.needed else 'no'}: {c.detail}" for c in checks}
    return {**marks, "failed": any(c.needed and not c.works for c in checks)}


def _demo(given: argparse.Namespace) -> Result:
    from lfd.loops.demo import demo, rows_of
    from lfd.loops.results import write_section
    from lfd.terminal import progress_bar

    recipes = given.dataset_recipe, given.policy_recipe
    measured = demo(*recipes, given.out, overwrite=given.overwrite, progress=progress_bar)
    if given.results is not None:
        write_section(given.results, "The thread on Lift with a Panda", "lfd demo", rows_of(measured))
    return measured if given.json else dict(rows_of(measured))


def _bench(given: argparse.Namespace) -> Result:
    from lfd.loops.results import write_section

    measured, sections = _bench_sim(given) if given.suite == "sim" else _bench_cameras(given)
    if given.results is not None:
        command = f"lfd bench {given.suite}" + " --quick" * given.quick + " --full" * given.full
        for title, rows in sections.items():
            write_section(given.results, title, command, rows)
    return measured


def _bench_cameras(given: argparse.Namespace) -> tuple[Result, Result]:
    from lfd.bench.cameras import bench_cameras
    from lfd.terminal import progress_bar

    measured = asdict(
        bench_cameras(
            task=given.task,
            robot=given.robot,
            control_hz=20,
            cameras=("agentview", "robot0_eye_in_hand"),
            sizes=(84, 256),
            states=10 if given.quick else 40,
            seed=given.seed,
            progress=progress_bar,
        )
    )
    rows = measured["ratios"] | {"mean difference [1/255]": measured["mean_difference"]}
    rows |= {f"frames/s, {name}": rate for name, rate in measured["frames_per_second"].items()}
    return measured, {f"Cameras: {given.task} with {given.robot}": rows}


def _bench_sim(given: argparse.Namespace) -> tuple[Result, Result]:
    from lfd.bench.matrix import bench_matrix, success_rates, whole_matrix
    from lfd.bench.sim import bench_everywhere, bench_sim
    from lfd.terminal import progress_bar

    common: dict[str, Any] = {"control_hz": 20, "seed": given.seed, "progress": progress_bar}
    episodes = 2 if given.quick else 20
    measured = asdict(bench_sim(task=given.task, robot=given.robot, episodes=episodes, **common))
    sections = {
        f"Simulation: {given.task} with {given.robot}": measured["ratios"]
        | {f"steps/s, {name}": rate for name, rate in measured["steps_per_second"].items()}
    }
    if given.full:
        measured["everywhere"] = bench_everywhere(**common)
        measured["matrix"] = asdict(bench_matrix(whole_matrix(), steps=10, **common))
        rates = success_rates(task="Lift", robot="panda", episodes=100, **common)
        measured["success"] = rates
        said = {
            name: f"{won} of 100, 95% interval {low:.1%} to {high:.1%}" for name, (won, (low, high)) in rates.items()
        }
        sections["Simulation: success of a noisy expert on both steppers"] = said
        sections["Simulation: every task with a Panda, every robot on Lift"] = {
            pair: ", ".join(f"{name} {value}" for name, value in ratios.items())
            for pair, ratios in measured["everywhere"].items()
        }
        sections["Simulation: same numbers as robosuite, every robot x controller x task"] = measured["matrix"]
    return measured, sections


@contextmanager
def _machines(address: str | None) -> Iterator[Any]:
    """The cluster that was asked for, or none."""
    if address is None:
        yield None
        return
    from lfd.cluster import connect

    with connect(address) as cluster:
        print(f"{cluster.cpus} cores in the Ray cluster {address}", file=sys.stderr)
        yield cluster


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 1")
    return int(text)


def _put(tables: dict[str, dict[str, Any]], table: str, **values: Any) -> None:
    """Put the options that were given over the recipe's keys."""
    tables.setdefault(table, {}).update({key: value for key, value in values.items() if value is not None})


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lfd",
        description="Robot learning from demonstration: record, convert, train, run and replay.",
        epilog=PIPELINE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], Result], summary: str, example: str) -> Any:
        made = commands.add_parser(
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
            "--worlds", type=_count, default=2**16, metavar="N",
            help="worlds to run in parallel at the most; the result is the same (default: one a core)",
        )  # fmt: skip
        cluster(made)

    made = command(
        "record",
        _record,
        "record demonstrations of a task into MCAP files, one an episode",
        "lfd record datasets/lift_panda.toml --episodes 50 --out outputs/recordings",
    )
    made.add_argument("recipe", type=Path, metavar="RECIPE", help="dataset recipe, a TOML file with a [record] table")
    made.add_argument("--episodes", type=int, metavar="N", help="successful demonstrations to record")
    made.add_argument("--seed", type=int, metavar="S", help="seed of start states and noise")
    parallel(made)
    output(made, "the recordings")
    overrides(made)

    made = command(
        "convert",
        _convert,
        "convert recordings into a LeRobot v3 dataset and verify it by reading both back",
        "lfd convert outputs/recordings --out outputs/dataset",
    )
    made.add_argument("sources", type=Path, nargs="+", metavar="FILE|DIR", help="recordings, or folders of them")
    made.add_argument(
        "--recipe", type=Path, metavar="RECIPE",
        help="dataset recipe whose [convert] table says what becomes what; default: the one kept in the recordings",
    )  # fmt: skip
    output(made, "the dataset")

    made = command(
        "train",
        _train,
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
        _eval,
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
        _sweep,
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
        _replay,
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
        _info,
        "say what a recording, dataset, policy, evaluation or recipe holds",
        "lfd info outputs/recordings/episode_000000.mcap",
    )
    made.add_argument("path", type=Path, metavar="PATH", help="file or folder")

    command("doctor", _doctor, "say what of this machine works", "lfd doctor")

    made = command(
        "bench",
        _bench,
        "measure speed side by side: sim (robosuite's step, ours, the physics alone) or cameras (robosuite's, ours)",
        "lfd bench sim --quick",
    )
    made.add_argument("suite", choices=["sim", "cameras"], help="what to measure")
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
        _demo,
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
