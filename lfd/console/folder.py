"""What the console may touch: one folder, and the recipes beside it."""

from dataclasses import dataclass
from pathlib import Path

from lfd.core.artifact import read_manifest
from lfd.core.errors import InputError
from lfd.record.mcap_file import SUFFIX

MOST = 300
"""Artifacts that are listed at most, the latest first."""


@dataclass(frozen=True)
class Artifact:
    """Something that lfd made."""

    name: str
    """Path below the folder."""
    kind: str
    """What its manifest says."""
    changed: float


class Folder:
    """The folder of a console."""

    def __init__(self, path: Path):
        self.path = path.resolve()

    def place(self, name: str) -> Path:
        """The path of a name below the folder. Raises `InputError` for one that leads out of it."""
        parts = Path(name.strip()).parts
        if not parts or "\0" in name:
            raise InputError("a name is missing: say where below the console's folder it shall go, such as mine")
        path = (self.path / Path(*parts)).resolve()
        if not path.is_relative_to(self.path) or path == self.path:
            raise InputError(f"{name} leads out of the console's folder; give a name below it, such as mine")
        return path

    def artifacts(self, *kinds: str) -> list[Artifact]:
        """What is there, of some kinds or of all, the latest first."""
        found = []
        for file in self.path.rglob("manifest.json"):
            if file.parent == self.path or any(part.startswith(".") for part in file.relative_to(self.path).parts):
                continue
            kind = str((read_manifest(file.parent) or {}).get("kind", ""))
            if kind and (not kinds or kind in kinds):
                name = str(file.parent.relative_to(self.path))
                found.append(Artifact(name, kind, file.stat().st_mtime))
        return sorted(found, key=lambda one: -one.changed)[:MOST]


def recipes(folder: Path, table: str) -> list[str]:
    """The recipes in a folder that have a table; their names, without the ending."""
    return sorted(file.stem for file in folder.glob("*.toml") if f"[{table}]" in file.read_text(encoding="utf-8"))


def episodes_of(path: Path) -> list[Path]:
    """The recordings in a folder, or in those of an evaluation below it."""
    return sorted(path.rglob(f"*{SUFFIX}"))
