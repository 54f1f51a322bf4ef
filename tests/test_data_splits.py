import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lfd.core.errors import DatasetError
from lfd.data.splits import split_episodes


@given(lengths=st.lists(st.integers(1, 5), min_size=2, max_size=30), fraction=st.floats(0.01, 0.5), seed=st.integers(0))
def test_episodes_stay_whole(lengths, fraction, seed) -> None:
    episodes = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    train, validation = split_episodes(episodes, fraction, seed)
    held = set(episodes[validation].tolist())
    assert len(held) == max(1, round(fraction * len(lengths)))
    assert not held & set(episodes[train].tolist())
    assert torch.equal(torch.cat([train, validation]).sort().values, torch.arange(len(episodes)))
    assert torch.equal(split_episodes(episodes, fraction, seed)[1], validation)


def test_nothing_is_held_out_with_a_fraction_of_0() -> None:
    train, validation = split_episodes(torch.tensor([0, 0, 1]), 0.0, 0)
    assert train.tolist() == [0, 1, 2]
    assert validation.tolist() == []


def test_another_seed_holds_out_other_episodes() -> None:
    episodes = torch.arange(50)
    assert split_episodes(episodes, 0.2, 0)[1].tolist() != split_episodes(episodes, 0.2, 1)[1].tolist()


def test_too_few_episodes_are_an_error() -> None:
    with pytest.raises(DatasetError, match="1 episodes cannot be split: 1 would be held out"):
        split_episodes(torch.tensor([0, 0]), 0.1, 0)
