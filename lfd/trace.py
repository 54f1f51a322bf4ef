"""Where an artifact comes from: its parents by hash, their parents, and whether they are still what they were."""

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lfd.core.artifact import read_manifest, sha256
from lfd.core.errors import InputError

INTACT, CHANGED, MISSING = "intact", "changed", "missing"
SHOWN = 3
"""Parents of one folder that are shown one by one; of more, only their number is."""


@dataclass(frozen=True, kw_only=True)
class Origin:
    """An artifact in the chain."""

    path: str
    kind: str
    """What its manifest says that it is, or `file`."""
    state: str
    """Whether its content has the hash that its child noted: intact, changed or missing."""
    made: str
    """When, by which commit and with which seed."""
    parents: tuple["Origin", ...]


def trace(path: Path) -> Origin:
    """The chain that ends in the artifact at `path`.

    Raises `InputError` for a path that has no manifest.
    """
    if not path.exists():
        raise InputError(f"nothing at {path}; give a dataset, policy, evaluation or export")
    if not path.is_dir() or read_manifest(path) is None:
        raise InputError(f"{path} has no manifest.json, so nothing is known of its origin")
    return _origin(path, None)


def _origin(path: Path, noted: str | None) -> Origin:
    if not path.exists():
        return Origin(path=str(path), kind="unknown", state=MISSING, made="", parents=())
    state = INTACT if noted is None or sha256(path) == noted else CHANGED
    manifest = read_manifest(path) if path.is_dir() else None
    if manifest is None:
        return Origin(path=str(path), kind="file" if path.is_file() else "folder", state=state, made="", parents=())
    made = f"{manifest.get('made', '')}, commit {manifest.get('commit') or 'unknown'}, seed {manifest.get('seed')}"
    parents = tuple(_origin(_found(parent, path), digest) for parent, digest in manifest.get("parents", {}).items())
    return Origin(path=str(path), kind=str(manifest.get("kind")), state=state, made=made, parents=parents)


def _found(parent: str, child: Path) -> Path:
    """The path of a parent as it was noted: from here, or from one of the folders that its child is in."""
    places = (Path(), *child.resolve().parents)
    return next((place / parent for place in places if (place / parent).exists()), Path(parent))


def as_json(origin: Origin) -> dict[str, Any]:
    """The chain as plain values."""
    return asdict(origin)


def lines_of(origin: Origin, indent: str = "") -> list[str]:
    """The chain as indented lines, child first."""
    made = f" ({origin.made})" if origin.made else ""
    lines = [f"{indent}{origin.kind} {origin.path}: {origin.state}{made}"]
    deeper = indent + "  "
    folders: dict[str, list[Origin]] = {}
    for parent in origin.parents:
        folders.setdefault(str(Path(parent.path).parent), []).append(parent)
    for folder, parents in folders.items():
        if len(parents) <= SHOWN or any(parent.parents for parent in parents):
            for parent in parents:
                lines += lines_of(parent, deeper)
        else:
            states = Counter(parent.state for parent in parents)
            told = ", ".join(f"{count} {state}" for state, count in states.items())
            lines.append(f"{deeper}{len(parents)} files in {folder}: {told}")
            lines += [f"{deeper}  {p.path}: {p.state}" for p in parents if p.state != INTACT][:SHOWN]
    return lines
