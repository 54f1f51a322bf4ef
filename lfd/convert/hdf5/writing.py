"""New HDF5 files, which appear when they are whole. The only module that imports h5py for writing."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from lfd.core.artifact import UNWRITABLE
from lfd.core.errors import OutputError


class Disk:
    """A new file for h5py, which keeps the disk's first error to itself and takes everything after it.

    On a full disk libhdf5 raises in destructors and may crash; so it never hears of it, and `check` tells.
    """

    def __init__(self, path: Path):
        self._raw, self._error = path.open("x+b", buffering=0), None

    def check(self) -> None:
        """Raise the first error, if there was one."""
        if self._error is not None:
            raise self._error

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self._error is None:
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            self._error = error
        return size

    def read(self, size: int = -1) -> bytes:
        """By this h5py knows a file from a path; it reads with `readinto`."""
        return self._raw.read(size) or b""

    def readinto(self, buffer: Any) -> int:
        return self._raw.readinto(buffer) or 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        return self._raw.tell()

    def truncate(self, size: int | None = None) -> int:
        try:
            return self._raw.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size or 0

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close the file when it is on the disk."""
        with self._raw:
            if self._error is None:
                os.fsync(self._raw.fileno())


@contextmanager
def new_hdf5(out: Path, *, overwrite: bool) -> Iterator[tuple[Any, Disk]]:
    """An HDF5 file that takes the place of `out` when the block ends well, and is removed otherwise.

    The block calls `Disk.check` now and then, to end early on a full disk. Raises `OutputError` when `out` exists
    and may not be replaced, or cannot be written.
    """
    if out.is_dir() or (out.exists() and not overwrite):
        raise OutputError(f"{out} exists already; choose another --out, or add --overwrite to replace a file")
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)
        disk = Disk(part)
        try:
            with h5py.File(disk, "w") as file:
                yield file, disk
        finally:
            disk.close()
        disk.check()
        os.replace(part, out)
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        raise OutputError(f"cannot write {out}: {error.strerror}; free space or choose another --out") from error
    finally:
        if part.parent.is_dir():
            part.unlink(missing_ok=True)
