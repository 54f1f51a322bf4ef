import torch
from hypothesis import given
from hypothesis import strategies as st

from lfd.data.batches import Batches


def sampler(count: int, size: int, *, seed: int = 0, replacement: bool = False) -> Batches:
    return Batches(torch.arange(count) + 10, size, torch.Generator().manual_seed(seed), replacement=replacement)


@given(count=st.integers(1, 20), size=st.integers(1, 50), epochs=st.integers(1, 4))
def test_an_epoch_holds_every_frame_once(count, size, epochs) -> None:
    batches = sampler(count, size)
    drawn = torch.cat([batches.next_index() for _ in range(-(-epochs * count // size))])
    for epoch in drawn[: epochs * count].view(epochs, count):
        assert epoch.sort().values.tolist() == list(range(10, 10 + count))


@given(
    count=st.integers(1, 20), size=st.integers(1, 50), before=st.integers(0, 30), replacement=st.booleans(),
)  # fmt: skip
def test_a_saved_state_goes_on_with_the_same_batches(count, size, before, replacement) -> None:
    first = sampler(count, size, replacement=replacement)
    for _ in range(before):
        first.next_index()
    resumed = sampler(count, size, seed=1, replacement=replacement)
    resumed.load_state({name: value.clone() for name, value in first.state().items()})
    for _ in range(10):
        assert torch.equal(first.next_index(), resumed.next_index())


def test_with_replacement_frames_are_drawn_as_often_as_chance_has_it() -> None:
    batches = sampler(4, 100, replacement=True)
    drawn = torch.cat([batches.next_index() for _ in range(100)])
    counts = torch.bincount(drawn - 10, minlength=4)
    assert abs(counts - 2500).max() < 5 * (10_000 * 0.25 * 0.75) ** 0.5  # five standard deviations
    assert counts.unique().numel() > 1  # without replacement all would be 2500


def test_epochs_have_orders_of_their_own() -> None:
    batches = sampler(100, 100)
    assert not torch.equal(batches.next_index(), batches.next_index())
