"""That the bench of training measures what it says, on the real loaders and loops but small."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lfd.bench.loading import LEROBOT, check_batches, kinds_of, lerobot_dataset
from lfd.bench.peers.process import Peer, PeerError, peer_python
from lfd.bench.train import make_dataset
from lfd.bench.turns import Turns, take_turns
from lfd.core.errors import VerificationError
from lfd.data.frames import load_frames
from lfd.data.windows import Windows
from tests.conftest import ROOT, call_json

LOADING = """
import json, sys, torch
from pathlib import Path
from lfd.bench.loading import measure_loading
from lfd.bench.train import make_dataset

torch.set_num_threads(1)
make_dataset(Path(sys.argv[1]), 5, 0)
kinds = ("plain", "chunks of 100", "horizon 16")
measure = lambda kind: measure_loading(Path(sys.argv[1]), kind, turns=3, seconds=0.1, workers=False)
print(json.dumps({kind: measure(kind) for kind in kinds}))
"""  # in a process where shapes are not enforced, which costs more than a batch
PEER = """
import sys
from serving import serve

print("a library greets")
assert sys.argv[2] == '{"hidden_sizes": [32], "batch_size": 8}', sys.argv[2]
serve(lambda steps: [print("a step") for _ in range(steps)] if steps < 10 else sys.exit("too many steps"))
"""


@pytest.mark.slow
def test_loading_is_no_bottleneck(tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOADING, str(tmp_path / "dataset")],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    found = json.loads(done.stdout.splitlines()[-1])
    least = {"plain": 50, "chunks of 100": 500, "horizon 16": 50}
    for kind, (rates, ratios) in found.items():
        assert ratios["vs LeRobot"] == pytest.approx(rates["lfd"] / rates[LEROBOT], rel=0.8)
        assert ratios["vs LeRobot"] > least[kind]
        assert ratios["vs index gather"] > 0.3


@pytest.mark.slow
def test_the_train_bench_answers_with_its_ratios() -> None:
    found = call_json(["bench", "train", "--quick"])
    assert found["missing"] == "not asked for"
    for name, rates in found["steps_per_second"].items():
        ratios = found["step_ratios"][name]
        assert ratios["vs limit: bare torch loop"] > 0.6  # 0.95 and more where nothing else runs
        assert ratios["vs LeRobot's loop"] > 1
        assert rates["lfd"] > rates["LeRobot's loop"]


def test_a_batch_that_is_not_lerobots_is_noticed(tmp_path) -> None:
    make_dataset(tmp_path / "dataset", 2, seed=0)
    frames = load_frames(tmp_path / "dataset")
    deltas = kinds_of(frames)["horizon 16"]
    dataset = lerobot_dataset(tmp_path / "dataset", deltas, frames.fps)
    check_batches(dataset, Windows(frames.columns, frames.episode_index, deltas), "horizon 16")
    actions = frames.columns["action"].clone()
    actions[199, 3] += 1e-6
    others = Windows({**frames.columns, "action": actions}, frames.episode_index, deltas)
    with pytest.raises(VerificationError, match=r"action of a batch \(horizon 16\) is not what LeRobot gives"):
        check_batches(dataset, others, "horizon 16")


def test_sides_take_turns_and_a_ratio_is_that_of_the_same_turn() -> None:
    order = []

    def side(name: str, seconds: float):
        def run(times: int) -> float:
            order.append(name)
            return times * seconds

        return run

    taken = take_turns({"fast": side("fast", 0.01), "slow": side("slow", 0.1)}, turns=3, seconds=1.0)
    assert order[-6:] == ["fast", "slow"] * 3
    assert taken.rate("fast") == pytest.approx(100)
    assert taken.ratio("fast", "slow") == pytest.approx(10)
    drifting = Turns({"a": [10, 20, 40], "b": [5, 10, 20]})
    assert drifting.ratio("a", "b") == 2
    assert drifting.rate("a") == 20


def test_a_peer_takes_the_steps_that_it_is_asked_for_and_says_why_it_ends(tmp_path) -> None:
    import lfd.bench.peers.process as process

    serving = Path(process.__file__).with_name("serving.py")
    (tmp_path / "serving.py").write_text(serving.read_text())
    (tmp_path / "program.py").write_text(PEER)
    with Peer(
        Path(sys.executable), tmp_path / "program.py", tmp_path / "rows", hidden_sizes=[32], batch_size=8
    ) as peer:
        assert 0 <= peer(3) < 1
        assert 0 <= peer(5) < 1
        with pytest.raises(PeerError, match=r"program.py ended: too many steps"):
            peer(10)
        with pytest.raises(PeerError, match=r"program.py ended: too many steps"):
            peer(1)


def test_a_peer_that_cannot_be_installed_is_a_sentence(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("UV_OFFLINE", "1")
    monkeypatch.setenv("UV_NO_CACHE", "1")
    monkeypatch.setenv("UV_NO_CONFIG", "1")
    said = []
    with pytest.raises(PeerError, match=r"uv pip install failed: "):
        peer_python(tmp_path / "peers", said.append)
    assert said == ["installing robomimic and imitation in an environment of their own"]


def test_threads_are_given_back() -> None:
    import lfd.bench.train as train

    def interrupted(label: str, total: int):
        raise KeyboardInterrupt

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyboardInterrupt):
            train.bench_train(
                episodes=1, turns=1, seconds=0.1, peers=False, workers=False, seed=0, progress=interrupted
            )
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
