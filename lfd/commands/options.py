"""What the commands of the command line are made of: arguments that many of them take, and what they share in running.

A command's arguments stand beside the function that runs it, in the other modules of this package.
"""

import argparse
import os
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lfd.core.errors import InputError

Result = dict[str, Any]
ALL_WORLDS = 2**16
"""More worlds than any machine has cores: as many as it has."""


class Commands:
    """The commands of a parser."""

    def __init__(self, parser: argparse.ArgumentParser):
        self._parsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(self, name: str, run: Callable[[Namespace], Result], summary: str, example: str) -> Any:
        """Add a command; returns its parser."""
        made = self._parsers.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        made.set_defaults(command=run, name=name)
        made.add_argument("--json", action="store_true", help="print the result as one JSON object on standard output")
        return made


def count(text: str) -> int:
    """A number of at least 1, as an argument."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 1")
    return int(text)


def output(made: Any, what: str) -> None:
    """Where a command writes."""
    made.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"folder for {what}")
    made.add_argument("--overwrite", action="store_true", help="replace the folder if it exists")


def overrides(made: Any) -> None:
    """Keys of the recipe from the command line."""
    made.add_argument(
        "--set", action="append", default=[], metavar="TABLE.KEY=VALUE",
        help="override any key of the recipe; `lfd info RECIPE` lists them; may be repeated",
    )  # fmt: skip


def cluster(made: Any) -> None:
    """Running on Ray."""
    made.add_argument(
        "--cluster", nargs="?", const="local", metavar="ADDRESS",
        help="run on Ray, with the same result: `local` (also without an address) starts it on this machine, "
        "`auto` joins the one that runs here, ray://HOST:10001 another; needs pip install 'lfd[cluster]'",
    )  # fmt: skip


def parallel(made: Any) -> None:
    """Running in many worlds."""
    made.add_argument(
        "--worlds", type=count, default=ALL_WORLDS, metavar="N",
        help="worlds to run in parallel at the most; the result is the same (default: one a core)",
    )  # fmt: skip
    cluster(made)


def live(made: Any, what: str) -> None:
    """Being watched while it runs."""
    made.add_argument(
        "--live", action="store_true",
        help=f"show {what}, in a browser on this machine (127.0.0.1 only, no internet needed)",
    )  # fmt: skip


@contextmanager
def watching(given: argparse.Namespace, title: str) -> Iterator[Any]:
    """A function that gives what watches the episodes of a run that begins, if that was asked for."""
    from lfd.core.protocols import unwatched

    if not given.live:
        yield lambda: unwatched
        return
    if getattr(given, "cluster", None) is not None:
        raise InputError("--live shows worlds of this machine, --cluster runs them elsewhere: leave out one of them")
    from lfd.replay.live_worlds import live_worlds

    with live_worlds(title, min(given.worlds, os.cpu_count() or 1), tell_live) as shown:
        yield shown.begin


@contextmanager
def watching_curves(given: argparse.Namespace) -> Iterator[Any]:
    """What takes the rows of a training's curve, if that was asked for."""
    is_first = os.environ.get("RANK", "0") == "0"  # of the processes that torchrun starts
    if not (given.live and is_first):
        yield None
        return
    from lfd.replay.live_worlds import live_curves

    with live_curves(tell_live) as report:
        yield report


def tell_live(address: str) -> None:
    """Say where a person can look."""
    print(f"live: {address}\n(over SSH: forward both ports, see docs/replay.md)", file=sys.stderr, flush=True)


@contextmanager
def machines(address: str | None) -> Iterator[Any]:
    """The cluster that was asked for, or none."""
    if address is None:
        yield None
        return
    from lfd.cluster import connect

    with connect(address) as cluster:
        print(f"{cluster.cpus} cores in the Ray cluster {address}", file=sys.stderr)
        yield cluster


def put(tables: dict[str, dict[str, Any]], table: str, **values: Any) -> None:
    """Put the options that were given over the recipe's keys."""
    tables.setdefault(table, {}).update({key: value for key, value in values.items() if value is not None})


def short(value: Any) -> str:
    """A value in few characters."""
    if isinstance(value, list):
        return "[" + ", ".join(map(short, value)) + "]"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
