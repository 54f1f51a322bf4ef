"""Commands on demonstrations: record and convert them, check where they come from.

Every command imports its stage when it runs, so that `lfd --help` answers at once.
"""

import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lfd.commands.options import (
    ALL_WORLDS,
    Commands,
    Result,
    cluster,
    count,
    live,
    machines,
    output,
    overrides,
    parallel,
    put,
    short,
    watching,
)
from lfd.core.errors import InputError
from lfd.experts.keys import HELP

MOST_NOTES = 10
"""Episodes whose notes are printed."""
USUAL = ("start_s", "pieces")
"""Notes that only matter beside others."""


def add(commands: Commands) -> None:
    """The commands of this module."""
    _record(commands)
    _convert(commands)
    _verify(commands)
    _export(commands)
    _trace(commands)
    _recover(commands)


def _record(commands: Commands) -> None:
    made = commands.add(
        "record",
        run_record,
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
    live(made, "the worlds in motion, and how many demonstrations succeeded so far")
    made.epilog += f"\n         lfd record datasets/lift_panda.toml --device keyboard --out outputs/mine\n\n{HELP}"
    parallel(made)
    output(made, "the recordings")
    overrides(made)


def run_record(given: Namespace) -> Result:
    """Demonstrations of a task."""
    from lfd.core.recipe import build, load_toml
    from lfd.record.demonstrations import RecordRecipe, record
    from lfd.terminal import progress_bar

    tables = load_toml(given.recipe, ("record", "convert", "video"), given.set)
    put(tables, "record", episodes=given.episodes, seed=given.seed)
    recipe = build(RecordRecipe, tables.get("record", {}), f"{given.recipe} [record]")
    if given.device is not None:
        if given.live:
            raise InputError(f"with --device {given.device} you see the robot already: leave out --live")
        return _record_person(given, recipe, tables)
    if given.no_view:
        raise InputError("--no-view is for people: choose their device with --device keyboard, spacemouse or gamepad")
    with watching(given, "recording") as begin, machines(given.cluster) as cluster:
        done = record(
            recipe,
            given.out,
            tables=tables,
            most_worlds=given.worlds,
            cluster=cluster,
            observers=begin(),
            resume=given.resume,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    return {"out": str(given.out), **asdict(done)}


def _record_person(given: Namespace, recipe: Any, tables: dict[str, Any]) -> Result:
    """Demonstrations of the person at a device."""
    from lfd.core.artifact import check_output
    from lfd.experts.registry import open_device
    from lfd.record.session import record_session
    from lfd.terminal import StatusLine, progress_bar

    if given.cluster is not None or 1 < given.worlds < ALL_WORLDS:
        option = "--cluster" if given.cluster is not None else f"--worlds {given.worlds}"
        raise InputError(f"a person moves one robot at a time: leave out {option}, or --device {given.device}")
    if not given.resume:
        check_output(given.out, overwrite=given.overwrite)
    with open_device(given.device) as device, live_view(not given.no_view) as view, closing(StatusLine()) as status:
        done = record_session(
            recipe,
            given.out,
            device,
            tables=tables,
            view=view,
            status=status,
            resume=given.resume,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    return {"out": str(given.out), **asdict(done)}


@contextmanager
def live_view(wanted: bool) -> Iterator[Any]:
    """What a person sees of the world, with a word on where; or nothing."""
    if not wanted:
        yield None
        return
    from lfd.replay.live_view import live_view as opened

    with opened() as view:
        if view.address:
            print(
                f"live view: {view.address}\n(over SSH: forward both ports, see docs/teleoperation.md)", file=sys.stderr
            )
        yield view


def _convert(commands: Commands) -> None:
    made = commands.add(
        "convert",
        run_convert,
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
    made.add_argument("--jobs", type=count, metavar="N", help="processes that read (default: what is worth it)")
    cluster(made)
    output(made, "the dataset")


def run_convert(given: Namespace) -> Result:
    """A dataset from recordings."""
    from lfd.convert.sources import SourceRecipe
    from lfd.convert.to_lerobot import convert
    from lfd.terminal import progress_bar

    with machines(given.cluster) as cluster:
        done = convert(
            given.sources,
            given.out,
            recipe=SourceRecipe.load(given.recipe, trust_rows=given.trust_rows),
            append=given.append,
            skip_bad=given.skip_bad,
            jobs=given.jobs,
            cluster=cluster,
            overwrite=given.overwrite,
            progress=progress_bar,
        )
    result = {"out": str(given.out), **asdict(done)}
    if given.json:
        return result
    notes = {name: told for name, note in result.pop("notes").items() if (told := _noteworthy(note))}
    shown = {f"episode {name}": note for name, note in list(notes.items())[:MOST_NOTES]}
    if len(notes) > MOST_NOTES:
        shown["further episodes"] = f"{len(notes) - MOST_NOTES} with notes like these in {given.out}/manifest.json"
    return {key: value for key, value in result.items() if value not in ((), 0)} | shown


def _noteworthy(note: Result) -> str:
    """What a person should know of a converted episode: gaps, a recovery, how far a replay went away."""
    plain = {k: v for k, v in note.items() if isinstance(v, (str, int, float)) and v != "" and k not in USUAL}
    listed = {k: f"{len(v)} ({v[0]})" for k, v in note.items() if isinstance(v, (list, tuple)) and v}
    return ", ".join(f"{k} {short(v)}" for k, v in {**plain, **listed}.items())


def _verify(commands: Commands) -> None:
    made = commands.add(
        "verify",
        run_verify,
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


def run_verify(given: Namespace) -> Result:
    """Whether a dataset holds its sources."""
    from lfd.convert.sources import SourceRecipe
    from lfd.convert.verify import verify
    from lfd.terminal import progress_bar

    recipe = SourceRecipe.load(given.recipe) if given.recipe else None
    compared = verify(given.dataset, given.sources, recipe=recipe, progress=progress_bar)
    return {"dataset": str(given.dataset), "numbers_equal": compared}


def _export(commands: Commands) -> None:
    made = commands.add(
        "export",
        run_export,
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


def run_export(given: Namespace) -> Result:
    """Episodes in another program's format."""
    from lfd.convert.exporting import export
    from lfd.terminal import progress_bar

    done = export(
        given.sources,
        given.out,
        to=given.to,
        seed=given.seed,
        trust_rows=given.trust_rows,
        overwrite=given.overwrite,
        progress=progress_bar,
    )
    return asdict(done)


def _trace(commands: Commands) -> None:
    made = commands.add(
        "trace",
        run_trace,
        "print the chain policy, dataset, recordings, and whether each is still what it was",
        "lfd trace outputs/policy",
    )
    made.add_argument("path", type=Path, metavar="PATH", help="folder of a dataset, policy, evaluation or export")


def run_trace(given: Namespace) -> Result:
    """Where an artifact comes from."""
    from lfd.trace import as_json, lines_of, trace

    origin = trace(given.path)
    return as_json(origin) if given.json else {"lines": lines_of(origin)}


def _recover(commands: Commands) -> None:
    made = commands.add(
        "recover",
        run_recover,
        "make episodes of what a crash left, and of damaged recordings what is whole of them",
        "lfd recover outputs/recordings",
    )
    made.add_argument("folder", type=Path, metavar="DIR", help="folder of recordings")


def run_recover(given: Namespace) -> Result:
    """Episodes from what a crash left."""
    from lfd.record.recover import recover
    from lfd.terminal import progress_bar

    rows = [asdict(row) for row in recover(given.folder, progress=progress_bar)]
    if given.json:
        return {"files": rows}
    if not rows:
        return {str(given.folder): "every recording is whole"}
    return {row["path"]: f"{row['episode'] or 'nothing saved'}\n{row['note']}" for row in rows}
