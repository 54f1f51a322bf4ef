"""The process in which HDF5 files are opened; `lfd.convert.hdf5.demo_file` starts it and puts its answers into words.

libhdf5 can crash, loop, or ask for gigabytes when a file is damaged. Here that ends a process that has nothing else
to do. A request is a line of JSON on standard input with `path`, `demo` (null: the file as a whole) and `obs` (names
of observations, null: all). The answer on standard output is a line of JSON, then the bytes of the arrays it lists.

It is run as a file and imports nothing of lfd, so that it is there as soon as h5py is.
"""

import json
import math
import resource
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

TIMES_FILE = 4
"""What a file may claim, and what reading it may take: this many times its size, and the constants below."""
CLAIM = 32 * 2**20
"""Bytes that the datasets of one demonstration may claim beyond that."""
ROOM = 64 * 2**20
"""Bytes of address space beyond that: libhdf5's caches and what is on its way out."""
WORK_S, WAIT_S, BYTES_A_SECOND = 0.3, 60.0, 10e6
"""The process ends itself after so much work (CPU time), or time on the clock, and that of each byte of the file."""
DAMAGE = (
    OSError,
    RuntimeError,
    KeyError,
    ValueError,
    TypeError,
    AttributeError,
    MemoryError,
    OverflowError,
    SystemError,
)
"""What h5py raises on damaged files."""
FILE_ATTRIBUTES = ("env", "env_info", "env_args", "env_name", "repository_version", "total", "date", "time")
DEMO_ATTRIBUTES = ("num_samples", "model_file")
ARRAYS = ("actions", "states", "rewards", "dones")


class Unreadable(Exception):
    """Something in a file that is refused; the message says where."""


def main() -> None:
    """Answer requests until standard input ends."""
    for too_long in (signal.SIGPROF, signal.SIGALRM):
        signal.signal(too_long, signal.SIG_DFL)  # ends the process, whatever C code it is in
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks
    for line in sys.stdin.buffer:
        request = json.loads(line)
        size = Path(request["path"]).stat().st_size
        _limit_memory(size)
        _limit_time(size / BYTES_A_SECOND)
        arrays: dict[str, np.ndarray] = {}
        answer: dict[str, Any]
        try:
            answer = _answer(request, size, arrays)
        except Unreadable as error:
            answer, arrays = {"error": str(error)}, {}
        except DAMAGE as error:
            answer, arrays = {"error": f"the HDF5 library says {_words(error)}", "damaged": True}, {}
        _limit_time(None)
        answer["arrays"] = [(name, str(a.dtype), a.shape) for name, a in arrays.items()]
        answer["growth"] = _growth()
        sys.stdout.buffer.write(json.dumps(answer).encode() + b"\n")
        for array in arrays.values():
            sys.stdout.buffer.write(array.data.cast("B") if array.size else b"")
        sys.stdout.buffer.flush()


def _answer(request: dict[str, Any], size: int, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    with h5py.File(request["path"], "r", locking=False) as file:
        data = _inside(file, "data")
        if not isinstance(data, h5py.Group):
            raise Unreadable(f"it has no group 'data' of demonstrations; it holds {_listed(file)}")
        if request["demo"] is None:
            return {"attributes": _attributes(data, FILE_ATTRIBUTES), "demos": [_outline(data, str(n)) for n in data]}
        demo = _inside(data, request["demo"])
        if not isinstance(demo, h5py.Group):
            raise Unreadable(f"it is no group; data holds {_listed(data)}")
        found = dict(_datasets(demo, request["obs"]))
        claim = sum(math.prod(dataset.shape) * dataset.dtype.itemsize for dataset in found.values())
        if claim > TIMES_FILE * size + CLAIM:
            raise Unreadable(f"its datasets claim {claim:,} bytes, the file has {size:,}")
        for name, dataset in found.items():
            arrays[name] = _numbers(name, dataset)
        return {"attributes": _attributes(demo, DEMO_ATTRIBUTES), "holds": sorted(demo)}


def _outline(data: Any, name: str) -> dict[str, Any]:
    """What is known of a demonstration without reading its arrays."""
    demo = _inside(data, name)
    actions = _inside(demo, "actions") if isinstance(demo, h5py.Group) else None
    shape = list(actions.shape) if isinstance(actions, h5py.Dataset) and actions.shape is not None else None
    said = _attributes(demo, ("num_samples",)) if demo is not None else {}
    return {"name": name, "shape": shape, **said}


def _inside(group: Any, name: str) -> Any:
    """A member of a group; None where there is none. Links to other files are refused."""
    link = group.get(name, getlink=True)
    if link is None:
        return None
    if isinstance(link, h5py.ExternalLink):
        raise Unreadable(f"{name!r} is a link into another file; copy the data into this one (h5copy, h5repack)")
    return group[name]


def _datasets(demo: Any, wanted: list[str] | None) -> Iterator[tuple[str, Any]]:
    for name in ARRAYS:
        dataset = _inside(demo, name)
        if dataset is not None:
            yield name, _checked(name, dataset)
    seen = _inside(demo, "obs")
    if isinstance(seen, h5py.Group):
        for name in map(str, seen if wanted is None else wanted):
            dataset = _inside(seen, name)
            if dataset is None:
                raise Unreadable(f"it has no 'obs/{name}'; obs holds {_listed(seen)}")
            if isinstance(dataset, h5py.Dataset):
                yield f"obs/{name}", _checked(f"obs/{name}", dataset)
    elif wanted:
        raise Unreadable("it has no group 'obs'; convert it by its simulator states")


def _checked(name: str, dataset: Any) -> Any:
    if not isinstance(dataset, h5py.Dataset) or not dataset.shape or dataset.dtype.kind not in "fiub":
        raise Unreadable(f"'{name}' is no array of numbers")
    if dataset.external or dataset.is_virtual:
        raise Unreadable(f"'{name}' is kept in another file; copy it into this one (h5repack)")
    return dataset


def _numbers(name: str, dataset: Any) -> np.ndarray:
    try:
        values = np.ascontiguousarray(dataset[()])
    except DAMAGE as error:
        raise Unreadable(f"'{name}' cannot be read, the HDF5 library says {_words(error)}") from error
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _attributes(holder: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Those attributes among `names` that are there, as texts and numbers."""
    found: dict[str, Any] = {}
    for name in names:
        if name not in holder.attrs:
            continue
        value = holder.attrs[name]
        plain = value.decode() if isinstance(value, bytes) else value.item() if isinstance(value, np.generic) else value
        if isinstance(plain, bytes):
            plain = plain.decode()
        if not isinstance(plain, (str, int, float)):
            raise Unreadable(f"its attribute {name!r} is no text and no number")
        found[name] = plain
    return found


def _listed(group: Any) -> str:
    names = sorted(group)
    return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "") or "nothing"


def _words(error: Exception) -> str:
    """The library's reason, in its words."""
    return repr(str(error.args[0]) if error.args else type(error).__name__)


def _limit_time(more: float | None) -> None:
    """End the process after the limits and `more` seconds; None: no longer."""
    signal.setitimer(signal.ITIMER_PROF, 0.0 if more is None else WORK_S + more)
    signal.setitimer(signal.ITIMER_REAL, 0.0 if more is None else WAIT_S + more)


def _limit_memory(size: int) -> None:
    """Bound the address space, and begin to watch the memory in use; only Linux tells how much there is."""
    status = Path("/proc/self/statm")
    if status.exists():
        pages = int(status.read_text().split()[0])
        limit = pages * resource.getpagesize() + TIMES_FILE * size + CLAIM + ROOM
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak
        _before[:] = [_memory("VmRSS")]


def _growth() -> int:
    """Bytes by which the memory in use grew over the present request, at its peak."""
    return _memory("VmHWM") - _before[0] if _before else 0


def _memory(field: str) -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition(f"{field}:")[2].split()[0]) * 1024


_before: list[int] = []

if __name__ == "__main__":
    main()
