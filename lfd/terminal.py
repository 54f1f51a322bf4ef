"""What a person at a terminal sees: progress bars on standard error, tables on standard output."""

import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

STATUS_S = 0.2
"""Time between updates of a status line [s]."""


class _Bar:
    def __init__(self, progress: Progress, task: TaskID):
        self._progress, self._task = progress, task

    def advance(self, amount: int = 1, note: str = "") -> None:
        self._progress.update(self._task, advance=amount, note=note)


@contextmanager
def progress_bar(label: str, total: int) -> Iterator[_Bar]:
    """A progress bar with count, time gone and time left."""
    columns = (
        TextColumn("{task.description:<14}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        yield _Bar(progress, progress.add_task(label, total=total, note=""))


class StatusLine:
    """One line on standard error that is written over, or a line for each new state where that is no terminal.

    Nothing is written between the updates, and none of them ends the line: keys may be read meanwhile.
    """

    def __init__(self) -> None:
        self._state, self._shown, self._written = "", "", 0.0

    def __call__(self, state: str, detail: str) -> None:
        now, is_new = time.monotonic(), state != self._state
        if not is_new and now - self._written < STATUS_S:
            return
        self._state, self._written = state, now
        if sys.stderr.isatty():
            text = f"{state}  {detail}"[: shutil.get_terminal_size().columns - 1]
            if text != self._shown:
                sys.stderr.write(f"\r\x1b[2K{text}")
                sys.stderr.flush()
            self._shown = text
        elif is_new:
            print(f"{state}  {detail}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Leave the last state standing."""
        if self._state and sys.stderr.isatty():
            print(file=sys.stderr)


def print_table(title: str, rows: Mapping[str, object]) -> None:
    """Names and values, one a line."""
    table = Table(title=title, show_header=False, title_justify="left")
    for name, value in rows.items():
        table.add_row(Text(name), Text(str(value)))  # as they are: "[s]" is a unit, no markup
    Console().print(table)
