"""Measured results as a section of a Markdown page; nothing on that page is typed by hand."""

import os
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lfd.core.artifact import commit, versions


def write_section(page: Path, title: str, command: str, rows: Mapping[str, Any]) -> None:
    """Replace the section `title` of a Markdown page, or append it; other sections stay."""
    marker, stop = f"## {title}\n", "\n## "
    text = (
        page.read_text(encoding="utf-8") if page.is_file() else "# Results\n\nWritten by commands, never by hand.\n\n"
    )
    machine = f"{os.cpu_count()} cores, {platform.machine()}"
    used = ", ".join(f"{name} {number}" for name, number in versions().items())
    lines = [
        marker,
        f"`{command}`, {datetime.now(UTC):%Y-%m-%d}, commit {commit() or 'unknown'}, {machine}; {used}.\n",
        "| what | measured |\n| --- | --- |",
        *(f"| {name} | {value} |" for name, value in rows.items()),
        "",
    ]
    start = text.find(marker)
    if start < 0:
        page.write_text(text.rstrip("\n") + "\n\n" + "\n".join(lines), encoding="utf-8")
        return
    end = text.find(stop, start)
    rest = text[end + 1 :] if end >= 0 else ""
    page.write_text(text[:start] + "\n".join(lines) + ("\n" + rest if rest else ""), encoding="utf-8")
