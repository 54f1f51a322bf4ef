from collections.abc import Sequence
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from lfd.core.errors import DatasetError
from lfd.data.frames import load_frames
from lfd.data.windows import Windows, deltas_of, episode_ends
from tests.test_data_pictures import pictured

STATES_PADDED = ("observation.state_is_pad", "observation.environment_state_is_pad")
lengths_of_episodes = st.lists(st.integers(1, 6), min_size=1, max_size=5)
runs = st.builds(lambda begin, n: list(range(begin, begin + n)), st.integers(-7, 7), st.integers(1, 9))
windows = st.one_of(st.none(), runs, st.lists(st.integers(-9, 9), min_size=1, max_size=5))


def numbered(lengths: Sequence[int]) -> torch.Tensor:
    return torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))


@given(lengths=lengths_of_episodes, action=windows, state=windows, picture=windows)
def test_every_window_is_what_counting_gives(lengths, action, state, picture) -> None:
    episodes = numbered(lengths)
    count = len(episodes)
    columns = {
        "action": torch.arange(3.0 * count).view(count, 3),
        "observation.state": torch.arange(float(count)).view(count, 1),
        "observation.images.front": torch.arange(12 * count).view(count, 3, 2, 2).to(torch.uint8),
    }
    deltas = dict(zip(columns, (action, state, picture), strict=True))
    batch = Windows(columns, episodes, deltas).batch(torch.arange(count))
    padded = {f"{name}_is_pad" for name, window in deltas.items() if window is not None}
    assert set(batch) == set(columns) | padded
    begins = [sum(lengths[:episode]) for episode in range(len(lengths))]
    for name, window in deltas.items():
        if window is None:
            assert torch.equal(batch[name], columns[name])
            continue
        for frame in range(count):
            begin = begins[int(episodes[frame])]
            end = begin + lengths[int(episodes[frame])]
            for place, delta in enumerate(window):
                asked = frame + delta
                assert torch.equal(batch[name][frame, place], columns[name][min(max(asked, begin), end - 1)])
                assert bool(batch[f"{name}_is_pad"][frame, place]) == (not begin <= asked < end)


def test_the_windows_of_act_and_diffusion_are_lerobots_to_the_bit(thread) -> None:
    frames = load_frames(thread.dataset)
    for config in (ACTConfig(), DiffusionConfig()):
        assert batches_are_lerobots(thread.dataset, config, frames.columns, frames.episode_index) == {
            "action_is_pad": torch.bool,
            "action": torch.float32,
            "observation.state": torch.float32,
            "observation.environment_state": torch.float32,
        } | ({} if isinstance(config, ACTConfig) else dict.fromkeys(STATES_PADDED, torch.bool))


@pytest.mark.parametrize("codec", ["h264", "png"])
def test_windows_of_pictures_are_lerobots_to_the_bit(codec, tmp_path, rng) -> None:
    pictured(tmp_path / "dataset", codec, rng)
    frames = load_frames(tmp_path / "dataset")
    columns = {**frames.columns, **frames.images}
    found = batches_are_lerobots(tmp_path / "dataset", DiffusionConfig(), columns, frames.episode_index)
    assert found["observation.images.front"] == torch.uint8


def batches_are_lerobots(root, config: Any, columns, episode_index) -> dict[str, torch.dtype]:
    """Compare frames at the ends of episodes and in between with LeRobot's items; returns what a batch has."""
    about = LeRobotDatasetMetadata("lfd/test", root=root)
    timestamps = resolve_delta_timestamps(config, about)
    dataset: Any = LeRobotDataset("lfd/test", root=root, delta_timestamps=timestamps, video_backend="pyav")
    first, last = episode_ends(episode_index)
    from_end = torch.minimum(torch.arange(len(dataset)) - first, last - torch.arange(len(dataset)))
    frames = torch.nonzero((from_end < 10) | (from_end % 13 == 0))[:, 0]
    ours = Windows(columns, episode_index, deltas_of(config, columns)).batch(frames)
    for row, index in enumerate(frames.tolist()):
        item = dataset[index]
        assert {name for name in item if name.removesuffix("_is_pad") in columns} == set(ours)
        for name, rows in ours.items():
            values = rows[row].float() / 255 if rows.dtype == torch.uint8 else rows[row]
            assert torch.equal(item[name], values), (name, index)
    return {name: rows.dtype for name, rows in ours.items()}


def test_frames_that_a_chunk_would_run_out_of_are_left_out() -> None:
    windows = Windows({"action": torch.zeros(9, 1)}, numbered([4, 2, 3]), {"action": None})
    assert windows.sampleable(0).tolist() == list(range(9))
    assert windows.sampleable(2).tolist() == [0, 1, 6]
    with pytest.raises(DatasetError, match="the longest episode has 4 frames, the policy leaves out the last 4"):
        windows.sampleable(4)


def test_the_frames_left_out_are_lerobots(thread) -> None:
    frames = load_frames(thread.dataset)
    first, last = episode_ends(frames.episode_index)
    sampler = EpisodeAwareSampler(first.unique().tolist(), (last.unique() + 1).tolist(), drop_n_last_frames=7)
    windows = Windows(frames.columns, frames.episode_index, dict.fromkeys(frames.columns))
    assert windows.sampleable(7).tolist() == sampler.indices


def test_a_batch_is_a_copy() -> None:
    columns = {"action": torch.zeros(4, 2), "observation.state": torch.zeros(4, 2)}
    windows = Windows(columns, numbered([4]), {"action": range(2), "observation.state": None})
    for rows in windows.batch(torch.tensor([0, 3])).values():
        rows.fill_(True)
    assert not any(rows.any() for rows in columns.values())
    again = windows.batch(torch.tensor([0, 3]))
    assert not again["action"].any()
    assert again["action_is_pad"].tolist() == [[False, False], [False, True]]
