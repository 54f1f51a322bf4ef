"""What there is to be seen at a path: the episodes of a recording, a folder, a dataset, an evaluation, rounds."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.core.artifact import read_manifest
from lfd.core.errors import InputError
from lfd.record.episode_file import END, recordings_in
from lfd.record.mcap_file import SUFFIX, read_mcap
from lfd.replay.clip import Clip, ShapesOf, no_shapes, recording_clip
from lfd.replay.dataset_clip import dataset_clip, is_dataset

ROUND = "round_"
"""How the folders of DAgger's rounds begin."""
MOST_AT_ONCE = 500
"""Episodes in one file or viewer: more would fill a browser's memory."""
WAYS_OUT = {
    "policy": "a policy has nothing to be seen until it acts: lfd eval {0} --out RUN, then lfd replay RUN",
    "reward": "a reward has nothing to be seen until something is planned for it: lfd plan {0} --out PLANS, then "
    "lfd replay PLANS",
}
"""Kinds of artifacts without episodes, and what to type instead."""


@dataclass(frozen=True)
class Entry:
    """Something to be seen: an episode, or several things side by side."""

    title: str
    open: Callable[[], tuple[Clip, ...]]
    """Reads it."""
    succeeded: Callable[[], bool | None]
    """Whether it ended in success; None where nobody says so."""


@dataclass(frozen=True)
class Listing:
    """What is at a path, in order."""

    source: Path
    kind: str
    entries: tuple[Entry, ...]

    def chosen(self, numbers: Sequence[int] | None) -> dict[int, Entry]:
        """The entries of some numbers, or all, by number.

        Raises `InputError` for one that is not there, or too many at once.
        """
        wanted = list(range(len(self.entries))) if numbers is None else list(numbers)
        for number in wanted:
            if not 0 <= number < len(self.entries):
                raise InputError(
                    f"{self.source} has episodes 0 to {len(self.entries) - 1}, not {number}; "
                    f"lfd replay {self.source} --list names them"
                )
        if len(wanted) > MOST_AT_ONCE:
            raise InputError(
                f"{len(wanted)} episodes are more than a viewer takes; choose up to {MOST_AT_ONCE}, for example with "
                "--episodes 0-99"
            )
        return {number: self.entries[number] for number in wanted}


def listing_of(source: Path, round_number: int | None = None, shapes_of: ShapesOf = no_shapes) -> Listing:
    """What is at a path; of a DAgger run the round with a number, else all. `shapes_of` says what stands in a scene.

    Raises `InputError` when there is nothing, or nothing to be seen, with a word on what to type.
    """
    if not source.exists():
        raise InputError(
            f"nothing at {source}; give a recording, or the folder of recordings, a dataset, an evaluation, a DAgger "
            "run, corrections, a comparison or an interaction"
        )
    manifest = read_manifest(source) if source.is_dir() else None
    kind = (manifest or {}).get("kind", "recordings" if source.is_dir() else "recording")
    rounds = sorted(path for path in source.glob(f"{ROUND}*") if path.is_dir()) if kind == "dagger" else []
    if round_number is not None:
        rounds = [_round(source, rounds, round_number)]
    if rounds:
        parts = [listing_of(path / "recordings", shapes_of=shapes_of) for path in rounds if _has(path)]
        return _joined(source, kind, parts)
    if is_dataset(source):
        return _of_dataset(source)
    if kind in WAYS_OUT:
        raise InputError(WAYS_OUT[kind].format(source))
    if source.is_file() and source.suffix != SUFFIX:
        raise InputError(f"{source} is no {SUFFIX} file; {_hint(source)}")
    return Listing(source, kind, tuple(_of_file(path, source, shapes_of) for path in recordings_in([source])))


def _hint(source: Path) -> str:
    """What to type for a file of another kind."""
    if source.suffix == ".rrd":
        return f"Rerun opens it by itself: rerun {source}"
    if source.suffix in (".hdf5", ".h5", ".bag", ".db3"):
        return f"convert it first: lfd convert {source} --out DATASET, then lfd replay DATASET"
    return "give a recording, or a folder of recordings, a dataset or an evaluation"


def _has(folder: Path) -> bool:
    return any((folder / "recordings").glob(f"*{SUFFIX}"))


def _round(source: Path, rounds: Sequence[Path], number: int) -> Path:
    """The folder of a round that has recordings."""
    there = {int(path.name.removeprefix(ROUND)): path for path in rounds if _has(path)}
    if not rounds:
        raise InputError(f"{source} is no DAgger run and has no rounds; leave out --round")
    if number not in there:
        raise InputError(f"{source} has recordings of the rounds {', '.join(map(str, there))}, not of {number}")
    return there[number]


def _joined(source: Path, kind: str, parts: Sequence[Listing]) -> Listing:
    """The entries of several folders, each with the name of its own."""
    entries = []
    for part in parts:
        place = part.source.relative_to(source).as_posix().removesuffix("/recordings")
        entries += [_named(entry, f"{place}/{entry.title}") for entry in part.entries]
    if not entries:
        raise InputError(f"{source} has no recordings yet; lfd dagger ... --out {source} --resume goes on")
    return Listing(source, kind, tuple(entries))


def _named(entry: Entry, title: str) -> Entry:
    return Entry(title, lambda: tuple(replace(clip, title=title) for clip in entry.open()), entry.succeeded)


def _of_file(path: Path, source: Path, shapes_of: ShapesOf) -> Entry:
    title = path.name if path == source or path.parent == source else path.relative_to(source).as_posix()

    def succeeded() -> bool | None:
        told = read_mcap(path).metadata.get(END, {}).get("success")
        return None if told is None else bool(json.loads(told))

    return Entry(title, lambda: (replace(recording_clip(path, shapes_of), title=title),), succeeded)


def _of_dataset(root: Path) -> Listing:
    files = DatasetFiles(root)

    def entry(number: int) -> Entry:
        def opened() -> tuple[Clip, ...]:
            return (dataset_clip(root, number),)

        return Entry(f"{root.name} episode {number}", opened, lambda: opened()[0].success)

    return Listing(root, "dataset", tuple(entry(number) for number in range(len(files))))


def numbers_of(text: str) -> tuple[int, ...]:
    """The numbers of `0,3,7-9`. Raises `InputError` for another text."""
    found: list[int] = []
    for part in text.split(","):
        told = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if told is None:
            raise InputError(f"--episodes {text}: {part!r} is no number and no range; write for example 0,3,7-9")
        first, last = int(told[1]), int(told[2] or told[1])
        if last < first or last - first >= MOST_AT_ONCE:
            raise InputError(f"--episodes {text}: {part!r} is no range of 1 to {MOST_AT_ONCE} episodes")
        found += range(first, last + 1)
    if len(set(found)) < len(found):
        raise InputError(f"--episodes {text}: give each number once")
    return tuple(found)
