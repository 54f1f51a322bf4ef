"""Damaged MCAP files by the thousand: each is read, or refused in words, quickly and in little memory."""

import struct
import time
import tracemalloc
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from lfd.core.errors import LfdError
from lfd.record.episode_file import read_episode
from lfd.record.mcap_file import read_mcap, salvage_mcap
from tests.small_recordings import part, write_all

DATA = Path(__file__).parent / "data"
FILES = 10_000
SALVAGED = 5
"""Every so many files are also salvaged."""
LONGEST_S = 2.0
MOST_BYTES = 8 * 2**20
"""Beside four times the size of the file."""


@pytest.fixture(scope="module")
def bases(recorded, tmp_path_factory) -> list[bytes]:
    """A recording of ours, without the model that is most of it, and bags of other programs."""
    folder = tmp_path_factory.mktemp("bases")
    from dataclasses import replace

    small = [replace(part(recorded, begin, begin + 5), model_xml="<mujoco/>") for begin in (0, 5)]
    ours = [path.read_bytes() for path in write_all(folder, *small)]
    bags = [path.read_bytes() for path in sorted(DATA.glob("*.mcap")) if path.stat().st_size < 100_000]
    assert len(bags) == 3
    return ours + bags


def mutated(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """What was done, and the file after it."""
    made, size = bytearray(data), len(data)
    kind = ("cut", "flipped", "overwritten", "swapped", "garbage", "length", "spliced")[rng.integers(7)]
    if kind == "cut":
        return kind, data[: rng.integers(size)]
    if kind == "garbage":
        return kind, data[: rng.integers(200)] + rng.bytes(int(rng.integers(4000)))
    for _ in range(rng.integers(1, 20 if kind == "flipped" else 4)):
        at = int(rng.integers(size - 16))
        span = min(int(rng.integers(1, 600)), size - at)
        other = int(rng.integers(size - span + 1))
        if kind == "flipped":
            made[at] ^= 1 << int(rng.integers(8))
        elif kind == "overwritten":
            made[at : at + span] = (rng.bytes(span), bytes(span), b"\xff" * span)[rng.integers(3)]
        elif kind == "swapped":
            made[at : at + span], made[other : other + span] = made[other : other + span], made[at : at + span]
        elif kind == "spliced":  # everything behind moves
            made[at : at + span // 2] = data[other : other + span]
        else:  # a length, of a record or of something in it
            width = ("<I", "<Q")[rng.integers(2)]
            value = (0, 1, 2**31, 2**32 - 1, size, int(rng.integers(2 * size)))[rng.integers(6)]
            made[at : at + struct.calcsize(width)] = struct.pack(width, value)
    return kind, bytes(made)


def traced(read, path: Path) -> tuple[str, float, int]:
    """How reading ended, how long it took [s] and the memory that it took at the most [bytes]."""
    tracemalloc.reset_peak()
    before, began = tracemalloc.get_traced_memory()[0], time.perf_counter()
    try:
        read(path)
        ended = "read"
    except LfdError as error:
        ended = "refused" if path.name in str(error) else f"refused without its name: {error}"
    return ended, time.perf_counter() - began, tracemalloc.get_traced_memory()[1] - before


@pytest.mark.slow
def test_damaged_files_are_refused_in_words_and_cost_little(bases, tmp_path) -> None:
    rng, path = np.random.default_rng(11), tmp_path / "damaged.mcap"
    ended: Counter[str] = Counter()
    for number in range(2):  # what is imported and cached by the first does not count
        path.write_bytes(bases[number])
        assert len(read_episode(path)) == 5
        salvage_mcap(path)
    tracemalloc.start()
    try:
        for number in range(FILES):
            kind, data = mutated(bases[number % len(bases)], rng)
            path.write_bytes(data)
            readers = [read_mcap, read_episode] + [salvage_mcap] * (number % SALVAGED == 0)
            for read in readers:
                how, seconds, peak = traced(read, path)
                ended[f"{read.__name__} {how}"] += 1
                where = f"file {number}, {kind}, {read.__name__}"
                assert seconds < LONGEST_S, f"{where}: {seconds:.1f} s"
                assert peak <= 4 * len(data) + MOST_BYTES, f"{where}: {peak} bytes for {len(data)}"
    finally:
        tracemalloc.stop()
    assert {how.split(" ", 1)[1] for how in ended} == {"read", "refused"}, ended
    assert ended["read_mcap refused"] > FILES / 2
    assert ended["read_mcap read"] > 0  # a bit that nothing depends on
    assert ended["salvage_mcap read"] > 0


@pytest.mark.slow
def test_what_was_read_all_the_same_is_what_was_written(recorded, tmp_path) -> None:
    """Where every byte stands under a checksum, damage cannot go unseen."""
    (path,) = write_all(tmp_path, part(recorded, 0, 5))
    whole, rng = path.read_bytes(), np.random.default_rng(12)
    good = read_episode(path)
    for _ in range(300):
        _, data = mutated(whole, rng)
        path.write_bytes(data)
        try:
            episode = read_episode(path)
        except LfdError:
            continue
        np.testing.assert_array_equal(episode.actions, good.actions)
        np.testing.assert_array_equal(episode.sim_states, good.sim_states)
        assert episode.metadata == good.metadata
        assert episode.model_xml == good.model_xml
