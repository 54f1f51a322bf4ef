"""Work on more than one machine, with Ray; nothing else in lfd imports ray, and `import lfd.cluster` does not yet.

    with connect("local") as cluster:
        for index, result in cluster(function, shared, units):
            ...

Each unit becomes one task, `function(shared, unit)`, on one CPU of some machine that need not share a disk with
this one: units and `shared` carry what a worker needs as bytes, results bring back what it made. `shared`, for
example a policy, is sent to every machine once and not with every unit. Workers live on between units, so what is
slow to build, such as a world, belongs in a `functools.cache`. The results are those of one machine when
`function` depends on its arguments alone: the seed is in the unit, a second run trips over nothing that the first
left behind, and every machine has the same lfd.
"""

import logging
import os
import socket
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lfd.core.errors import InputError, LfdError

RUNS = 5
"""How often a unit is started before it is given up, when each run is lost with its worker."""
PATIENCE = 30.0
"""How long a cluster without a CPU is waited for [s]."""
OBJECT_STORE = 512 * 2**20
"""Shared memory of a `local` Ray for what is under way [bytes]; more goes to disk."""
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
WORKERS = {"env_vars": {**dict.fromkeys(THREADS, "1"), "HF_HUB_OFFLINE": "1"}}
RAY_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_AUTO_CONNECT": "0",  # or a call after the end starts a Ray of its own
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # or `uv run lfd` uploads the working directory
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # workers see the GPUs that this process sees
    "RAY_IGNORE_UNHANDLED_ERRORS": "1",  # the first error ends the work; the others are its like
}


class ClusterMap:
    """Runs a function over units on the workers of a cluster."""

    def __init__(self, address: str):
        self.address = address
        self.repeated = 0
        """Runs that were lost with their worker and done again, so far."""

    @property
    def cpus(self) -> int:
        """CPUs of the machines that are alive now."""
        import ray

        return int(ray.cluster_resources().get("CPU", 0))

    def __call__[Shared, Unit, Result](
        self, function: Callable[[Shared, Unit], Result], shared: Shared, units: Sequence[Unit]
    ) -> Iterator[tuple[int, Result]]:
        """Results as they finish, each with the index of its unit.

        `function` stands at the top of a module. A unit whose worker or machine dies is run again; it is an
        `LfdError` when it loses every worker, or no machine is left. What `function` raises is raised here, as
        itself. Units under way when the iteration ends early are cancelled.
        """
        import ray
        from ray import exceptions as of

        lost = (of.WorkerCrashedError, of.NodeDiedError, of.OutOfMemoryError, of.ObjectLostError)
        # Ray's own retries have no bound for a worker that runs out of memory; hence they are counted here.
        task: Any = ray.remote(num_cpus=1, max_retries=0)(function)
        at_hand = ray.put(shared)
        waiting, runs, running = deque(range(len(units))), Counter[int](), dict[Any, int]()
        try:
            while waiting or running:
                room = 2 * max(self.cpus, 1) - len(running)  # one at work and one ready for every CPU
                for index in [waiting.popleft() for _ in range(min(room, len(waiting)))]:
                    runs[index] += 1
                    running[task.remote(at_hand, units[index])] = index
                done, _ = ray.wait(list(running), timeout=PATIENCE)
                if not done and self.cpus == 0:
                    raise LfdError(f"no machine is left in the Ray cluster {self.address}")
                for reference in done:
                    index = running.pop(reference)
                    try:
                        result = ray.get(reference)
                    except of.RayError as error:
                        cause = error.cause if isinstance(error, of.RayTaskError) else error
                        if not isinstance(cause, of.RayError):
                            raise cause from error
                        if not isinstance(cause, lost):
                            raise LfdError(f"unit {index} failed on the cluster {self.address}: {cause}") from error
                        if runs[index] == RUNS:
                            why = f"it may crash or need too much memory; try it without --cluster. Ray says: {cause}"
                            raise LfdError(f"unit {index} lost its worker {RUNS} times: {why}") from error
                        self.repeated += 1
                        waiting.appendleft(index)
                    else:
                        yield index, result
        finally:
            for reference in running if ray.is_initialized() else ():
                ray.cancel(reference, force=True)


@contextmanager
def connect(address: str) -> Iterator[ClusterMap]:
    """`local` starts Ray on this machine's cores and stops it at the end; `auto` joins the one that runs here, and
    ray://HOST:10001 or HOST:6379 the one there, and leaves it running.

    Raises `InputError` when Ray is not installed, nothing answers, or Ray refuses, for example another version.
    """
    os.environ.update(RAY_ENVIRONMENT)
    try:
        import ray
        from ray._private import worker
        from ray.exceptions import RayError
    except ImportError as error:
        raise InputError("--cluster needs Ray: type pip install 'lfd[cluster]', or leave --cluster away") from error
    if ray.is_initialized():
        raise InputError("this process uses Ray already: call ray.shutdown() first")
    if address != "local":
        _check(address)
    own = {"include_dashboard": False, "object_store_memory": OBJECT_STORE} if address == "local" else {}
    worker._worker_logs_enabled = False  # or Ray prints on standard output what it thinks of dead workers
    try:
        try:
            ray.init(address, runtime_env=WORKERS, log_to_driver=False, logging_level=logging.ERROR, **own)
        except (ConnectionError, RuntimeError, ValueError, RayError) as error:
            token = "If it has a token, have its ~/.ray/auth_token here too and type export RAY_AUTH_MODE=token"
            raise InputError(f"--cluster {address}: Ray cannot join it: {error}\n{token}") from error
        yield ClusterMap(address)
    finally:
        ray.shutdown()
        worker._worker_logs_enabled = True


def _check(address: str) -> None:
    """Raise unless something answers: Ray itself tries for minutes."""
    from ray._private.services import get_ray_address_from_environment

    try:
        found = get_ray_address_from_environment("auto", None) if address == "auto" else address
        host, _, port = found.removeprefix("ray://").rpartition(":")
        if not (host and port.isdecimal()):
            raise InputError(f"--cluster {address}: expected local, auto, ray://HOST:10001 or HOST:6379")
        socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, OverflowError) as error:
        start = "start one with ray start --head, or leave --cluster away"
        raise InputError(f"--cluster {address}: no Ray cluster answers ({error}); {start}") from error
