"""What the commands of the command line are made of: arguments that many of them take, and what they share in running.

A command's arguments stand beside the function that runs it, in the other modules of this package.
"""

import argparse
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
