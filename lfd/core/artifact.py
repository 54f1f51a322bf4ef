"""Artifacts on disk: written under a temporary name, finished by rename, each with a manifest.

`manifest.json` says what an artifact is, from which recipe and which parents (by hash) it was made, with
which versions, seed and commit, so that any result can be traced to its recordings.
"""

import errno
import glob
import hashlib
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from lfd.core.errors import InputError, OutputError

MANIFEST = "manifest.json"
UNWRITABLE = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG}
LIBRARIES = ("lfd", "lerobot", "robosuite", "mujoco", "numpy", "torch", "mcap", "rerun-sdk")


@cache
def versions() -> Mapping[str, str]:
    """Versions of Python and of the libraries that decide results; `missing` where one is not installed."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


@cache
def commit() -> str:
    """Commit of the checkout that lfd runs from, with `+changes`; empty for an installed package."""
    here = Path(__file__).parent
    asked = ["git", "-C", str(here), "describe", "--always", "--dirty=+changes", "--abbrev=12"]
    try:
        answer = subprocess.run(asked, capture_output=True, text=True, check=False)
    except FileNotFoundError:  # no git on this machine
        return ""
    return answer.stdout.strip()


def sha256(path: Path) -> str:
    """Hash of a file, or of a folder's files by name and content; manifests do not count."""
    digest = hashlib.sha256()
    if path.is_file():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    for file in sorted(p for p in path.rglob("*") if p.is_file() and p.name != MANIFEST):
        digest.update(file.relative_to(path).as_posix().encode())
        digest.update(bytes.fromhex(sha256(file)))
    return digest.hexdigest()


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON so that `path` is always the old or the new content, whole."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, path)


def write_manifest(
    folder: Path, *, kind: str, recipe: Mapping[str, Any], parents: Mapping[str, str], seed: int, **facts: Any
) -> None:
    """Write `manifest.json`; `parents` maps the path of each source to its hash."""
    made = datetime.now(UTC).isoformat(timespec="seconds")
    content = {"kind": kind, "made": made, "seed": seed, "commit": commit(), "versions": dict(versions())}
    write_json(folder / MANIFEST, content | facts | {"recipe": dict(recipe), "parents": dict(parents)})


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of an artifact; None where there is none.

    Raises `InputError` when it is no JSON.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is no JSON ({error}); make the artifact again") from error


def check_output(path: Path, *, overwrite: bool) -> None:
    """Refuse an output folder that exists already, or that cannot be written, before any work is done.

    Raises `OutputError`.
    """
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path} is a file, expected a folder; choose another --out")
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise OutputError(f"{path} exists already; choose another --out, or add --overwrite to replace it")
    if path.is_dir() and any(path.iterdir()) and read_manifest(path) is None and any(_foreign(path)):
        raise OutputError(f"{path} holds files that lfd did not make; --overwrite will not delete them")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make {path.parent}: {error.strerror}; choose another --out") from error
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"cannot write into {path.parent}: permission denied; choose another --out")


def _foreign(folder: Path) -> Iterator[Path]:
    return (p for p in folder.iterdir() if p.suffix not in {".mcap", ".part"})


@contextmanager
def new_folder(path: Path, *, overwrite: bool, grow: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path` that takes its place when the block ends well, and is removed otherwise.

    To `grow` a folder is to begin with what is in it: its files are linked, not copied, and must be replaced and not
    changed. What a killed run left beside `path` is cleared away first.

    Raises `OutputError` when `path` exists and may not be replaced, or cannot be written.
    """
    heal(path)
    check_output(path, overwrite=overwrite or grow)
    part = _beside(path, str(os.getpid()), "part")
    try:
        part.mkdir(parents=True)
        if grow and path.is_dir():
            shutil.copytree(path, part, copy_function=_link, dirs_exist_ok=True)
        yield part
        if path.exists():
            old = _beside(path, str(os.getpid()), "old")
            path.rename(old)
            part.rename(path)
            shutil.rmtree(old)
        else:
            part.rename(path)
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        raise OutputError(f"cannot write {path}: {error.strerror}; free space or choose another --out") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _beside(path: Path, process: str, what: str) -> Path:
    return path.with_name(f".{path.name}.{process}.{what}")


def _link(source: str, target: str) -> None:
    """A second name for a file, or a copy where the file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def heal(path: Path) -> None:
    """Undo what runs that were killed left: half-made folders, and a folder that was about to be replaced."""
    if not path.parent.is_dir():
        return
    for left in path.parent.glob(f".{glob.escape(path.name)}.*"):
        process, _, what = left.name.removeprefix(f".{path.name}.").partition(".")
        if what not in ("part", "old") or not process.isdecimal() or _is_running(int(process)):
            continue
        if what == "old" and not path.exists():
            left.rename(path)
        else:
            shutil.rmtree(left, ignore_errors=True)


def _is_running(process: int) -> bool:
    """Whether another process has this number: in a container, a run may have that of the killed one before it."""
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's
        return True
    return True


def packed(folder: Path) -> dict[str, bytes]:
    """The files of a folder by their relative names, to be sent to another machine."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def unpack(files: Mapping[str, bytes], folder: Path) -> None:
    """Write what `packed` gave into a folder; each file appears under its name when it is whole.

    Raises `OutputError` when the disk is full or the folder cannot be written; what was finished before stays.
    """
    for name, content in files.items():
        path = folder / name
        part = path.with_name(path.name + ".part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(content)
            part.replace(path)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise OutputError(f"cannot write {path}: {error.strerror}; choose another --out") from error
