"""A map over processes of this machine; `lfd.cluster` has the same over machines."""

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

from lfd.core.errors import LfdError

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordinary_priority() -> None:
    """Take back the real-time priority that SVT-AV1 gives itself and its caller where it may, as root in a container.

    A thread of such priority never leaves its core to others: whatever else runs, browsers and workers, stands still.
    """
    if sys.platform != "linux":
        return
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has just ended
            if os.sched_getscheduler(int(task.name)) == os.SCHED_FIFO:
                os.sched_setscheduler(int(task.name), os.SCHED_OTHER, os.sched_param(0))


class ProcessMap:
    """Runs a function over units in processes of their own, at most `cpus` at a time; with one, in this process.

    Results come in the order of the units, and only some are computed ahead, so that what waits in memory is bounded.
    """

    def __init__(self, cpus: int):
        self.cpus = cpus

    def __call__[Shared, Unit, Result](
        self, function: Callable[[Shared, Unit], Result], shared: Shared, units: Sequence[Unit]
    ) -> Iterator[tuple[int, Result]]:
        """Results of `function(shared, unit)`, each with the index of its unit.

        `function` stands at the top of a module. What it raises is raised here; `LfdError` when a process dies.
        """
        if self.cpus <= 1 or len(units) <= 1:
            for index, unit in enumerate(units):
                yield index, function(shared, unit)
            return
        waiting, running = deque(enumerate(units)), deque[tuple[int, Future[Result]]]()
        with ProcessPoolExecutor(self.cpus, get_context("spawn"), _begin, (function, shared)) as pool:
            try:
                while waiting or running:
                    while waiting and len(running) < 2 * self.cpus:
                        index, unit = waiting.popleft()
                        with _deaf_to_ctrl_c():
                            running.append((index, pool.submit(_call, unit)))
                    index, future = running.popleft()
                    yield index, future.result()
            except BrokenProcessPool as error:
                raise LfdError("a worker process died, for example for lack of memory; try it with --jobs 1") from error
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Processes that start meanwhile leave Ctrl-C, which the terminal sends to all, to this one, which ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_work: tuple[Callable[[Any, Any], Any], Any] | None = None


def _begin(function: Callable[[Any, Any], Any], shared: Any) -> None:
    """What a process starts with: it keeps what all units share, and computes in one thread."""
    global _work
    for name in THREADS:
        os.environ[name] = "1"
    _work = function, shared
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A process whose parent was killed would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _call(unit: Any) -> Any:
    assert _work is not None
    function, shared = _work
    return function(shared, unit)


def in_order[Result](results: Iterator[tuple[int, Result]]) -> Iterator[Result]:
    """Results in the order of their units, whatever order they come in."""
    early: dict[int, Result] = {}
    wanted = 0
    for index, result in results:
        early[index] = result
        while wanted in early:
            yield early.pop(wanted)
            wanted += 1
