"""`lfd.cluster` on a real Ray: one machine, and two nodes of which one is killed."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfd.cluster import RUNS, connect
from lfd.core.errors import InputError, LfdError, PolicyError

STORE = 100 * 2**20


def draw(scale: float, seed: int) -> float:
    return scale * np.random.default_rng(seed).random()


def threads(name: str, unit: int) -> str | None:
    return os.environ.get(name)


def refuse(reason: str, unit: int) -> None:
    raise PolicyError(reason)


def divide(one: int, unit: int) -> float:
    return one / unit


def kill_itself(shared: None, unit: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def node(seconds: float, unit: int) -> str:
    import ray

    time.sleep(seconds)
    return ray.get_runtime_context().get_node_id()


def leave_marks(folder: str, seed: int) -> bytes:
    """Say in `folder` where the unit begins and when; the result is so large that it stays on its node."""
    (Path(folder) / f"{seed}.{node(0, seed)}.{time.time_ns()}").touch()
    time.sleep(0.5)
    return np.random.default_rng(seed).bytes(2**20)


@pytest.mark.slow
def test_local_gives_results_and_errors_and_prints_nothing_and_leaves_no_ray_behind(
    capfd: pytest.CaptureFixture[str],
):
    import ray

    before = descendants(os.getpid())
    with connect("local") as cluster:
        assert cluster.cpus >= 1
        assert cluster.address == "local"
        assert dict(cluster(draw, 2.0, range(30))) == {seed: draw(2.0, seed) for seed in range(30)}
        assert dict(cluster(draw, 2.0, [])) == {}
        assert dict(cluster(threads, "OMP_NUM_THREADS", [0])) == {0: "1"}
        with pytest.raises(PolicyError, match=r"^no weights in it$"):
            list(cluster(refuse, "no weights in it", [0]))
        with pytest.raises(ZeroDivisionError, match=r"^division by zero$"):
            list(cluster(divide, 1, [0, 1, 1, 1]))
        with pytest.raises(InputError, match="call ray.shutdown"), connect("local"):
            pass
        assert cluster.repeated == 0
        with pytest.raises(LfdError, match=f"unit 0 lost its worker {RUNS} times: it may crash or need too much"):
            list(cluster(kill_itself, None, [0]))
        assert cluster.repeated == RUNS - 1
        started = set(descendants(os.getpid())).difference(before)
        assert started
    assert not ray.is_initialized()
    assert capfd.readouterr() == ("", "")
    assert within(20, lambda: not started.intersection(parents()))


@pytest.fixture
def two_nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head and another node, of one CPU each."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    quickly = {"health_check_period_ms": 1000, "health_check_failure_threshold": 3}  # or a death shows after 15 s
    head = {"num_cpus": 1, "object_store_memory": STORE, "include_dashboard": False, "_system_config": quickly}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.add_node(num_cpus=1, object_store_memory=STORE)
    yield cluster
    cluster.shutdown()


@pytest.mark.slow
def test_units_of_a_node_that_is_killed_run_again_with_the_same_results(two_nodes: Any, tmp_path: Path):
    units = range(12)
    (victim,) = two_nodes.worker_nodes
    results: dict[int, bytes] = {}
    doomed: list[str] = []
    with connect(two_nodes.address) as cluster:
        assert cluster.cpus == 2
        assert within(30, lambda: len({place for _, place in cluster(node, 0.3, range(6))}) == 2)  # both have a worker
        for index, result in cluster(leave_marks, str(tmp_path), units):
            assert index not in results
            results[index] = result
            if not doomed:
                raylet = victim.all_processes["raylet"][0].process.pid
                processes = [raylet, *descendants(raylet)]
                if within(0.6, lambda: just_begun(tmp_path, victim.node_id)):
                    doomed = just_begun(tmp_path, victim.node_id)
                    for process in processes:
                        os.kill(process, signal.SIGKILL)
        assert cluster.repeated >= 1
    assert results == {seed: np.random.default_rng(seed).bytes(2**20) for seed in units}
    runs = Counter(mark.name.split(".")[0] for mark in tmp_path.iterdir())
    assert doomed
    assert all(runs[seed] == 2 for seed in doomed)


def just_begun(folder: Path, place: str) -> list[str]:
    """Seeds of the units that began on a node in the last fifth of a second."""
    marks = [path.name.split(".") for path in folder.glob(f"*.{place}.*")]
    return [seed for seed, _, began in marks if time.time_ns() - int(began) < 0.2e9]


def within(seconds: float, condition: Callable[[], Any]) -> bool:
    """Whether a condition comes true in time."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def parents() -> dict[int, int]:
    """The parent of every process that is alive."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = entry.read_text().rpartition(")")[2].split()[:2]
        except (FileNotFoundError, ProcessLookupError):  # ended meanwhile
            continue
        if state != "Z":
            found[int(entry.parent.name)] = int(parent)
    return found


def descendants(process: int) -> list[int]:
    children = [child for child, parent in parents().items() if parent == process]
    return children + [below for child in children for below in descendants(child)]


@pytest.mark.parametrize("address", ["nonsense", "ray://", "head:port", ":6379"])
def test_an_address_that_is_none_says_what_is_expected(address: str):
    with (
        pytest.raises(InputError, match=f"--cluster {address}: expected local, auto, ray://HOST:10001 or HOST:6379"),
        connect(address),
    ):
        pass


@pytest.mark.parametrize("address", ["auto", "127.0.0.1:1", "ray://127.0.0.1:1", "127.0.0.1:99999"])
def test_no_cluster_at_the_address_says_what_to_type(address: str):
    with (
        pytest.raises(InputError, match=f"--cluster {address}: no Ray cluster answers .*ray start --head, or leave"),
        connect(address),
    ):
        pass


def test_auto_does_not_wait_for_a_cluster_that_died(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(InputError, match="--cluster auto: no Ray cluster answers .*refused"), connect("auto"):
        pass


def test_without_ray_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with (
        pytest.raises(InputError, match=r"type pip install 'lfd\[cluster\]', or leave --cluster away"),
        connect("auto"),
    ):
        pass


def test_importing_the_module_does_not_import_ray():
    code = "import sys, lfd.cluster; sys.exit('ray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_an_evaluation_that_loses_a_node_is_the_same_episode_for_episode(two_nodes: Any, thread: Any, tmp_path: Path):
    from contextlib import nullcontext

    from lfd import evaluate, read_episode
    from lfd.run.trial import EvalRecipe

    # barely trained, it fails: three episodes to a unit, which takes about a second, and two units wait for a core
    recipe = EvalRecipe(episodes=24, seed=5, max_seconds=20.0, hold_seconds=0.5)
    (victim,) = two_nodes.worker_nodes
    raylet = victim.all_processes["raylet"][0].process.pid

    class KillsAtTheFirstEpisode:
        killed = False

        def advance(self, amount: int = 1, note: str = "") -> None:
            if not self.killed:
                self.killed = True
                time.sleep(0.2)  # by now the node is at work on the next of its units
                for process in [raylet, *descendants(raylet)]:
                    os.kill(process, signal.SIGKILL)

    alone = evaluate(thread.policy, recipe, tmp_path / "alone")
    with connect(two_nodes.address) as cluster:
        assert within(60, lambda: len({place for _, place in cluster(node, 0.3, range(6))}) == 2)
        killer = KillsAtTheFirstEpisode()
        together = evaluate(
            thread.policy, recipe, tmp_path / "ray", cluster=cluster, progress=lambda label, total: nullcontext(killer)
        )
        assert killer.killed
        assert cluster.repeated >= 1
    assert together.per_episode == alone.per_episode
    for index in range(12):
        here, there = (
            read_episode(tmp_path / place / "episodes" / f"episode_{index:06d}.mcap") for place in ("alone", "ray")
        )
        np.testing.assert_array_equal(here.sim_states, there.sim_states)


@pytest.mark.slow
def test_demonstrations_from_a_cluster_are_those_of_one_machine(tmp_path: Path):
    from dataclasses import replace

    from lfd import read_episode
    from lfd.core.recipe import build, load_toml
    from lfd.record.demonstrations import RecordRecipe, record

    tables = load_toml(Path("datasets/lift_panda.toml"), ["record", "convert"])
    recipe = replace(
        build(RecordRecipe, tables["record"], "recipe"), episodes=3, max_seconds=1.9, attempts_per_episode=20
    )
    alone = record(recipe, tmp_path / "alone", tables=tables)
    with connect("local") as cluster:
        together = record(recipe, tmp_path / "ray", tables=tables, cluster=cluster)
    assert (together.failures, together.steps) == (alone.failures, alone.steps)
    assert alone.failures > 0  # so that a second round was needed
    names = [path.name for path in sorted((tmp_path / "alone").glob("*.mcap"))]
    assert names == [path.name for path in sorted((tmp_path / "ray").glob("*.mcap"))]
    for name in names:
        here, there = (read_episode(tmp_path / place / name) for place in ("alone", "ray"))
        np.testing.assert_array_equal(here.sim_states, there.sim_states)
