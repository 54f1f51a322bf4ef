from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import lfd.data.pictures
from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.dataset.lerobot_writer import dataset_writer
from lfd.convert.dataset.video import VideoRecipe
from lfd.convert.frames import EpisodeFrames, Pictures
from lfd.convert.prepared import prepare
from lfd.core.errors import DatasetError
from lfd.data.frames import load_frames
from lfd.record.png import decode_png, encode_png

FRONT = "observation.images.front"
LENGTHS = (12, 5, 9)


def film(rng: np.random.Generator, length: int) -> list[np.ndarray]:
    """Pictures of 64 x 96, a little brighter from one to the next, with noise."""
    return [(rng.integers(0, 100, (64, 96, 3)) + 5 * t).astype(np.uint8) for t in range(length)]


def pictured(root: Path, codec: str, rng: np.random.Generator) -> list[list[np.ndarray]]:
    """A dataset of three episodes with random numbers and a camera, written by our writer; returns its pictures."""
    films = [film(rng, length) for length in LENGTHS]
    root.mkdir()
    with dataset_writer(root) as writer:
        for pictures in films:
            length = len(pictures)
            columns = {
                "observation.state": rng.normal(size=(length, 3)).astype(np.float32),
                "action": rng.normal(size=(length, 2)).astype(np.float32),
                "intervention": rng.random((length, 1)) < 0.5,
            }
            names = {name: tuple(f"{name}.{i}" for i in range(rows.shape[1])) for name, rows in columns.items()}
            frames = EpisodeFrames(
                source="made up", fps=20, task="look", columns=columns, names=names,
                units={name: ("m",) * len(parts) for name, parts in names.items()},
                pictures={FRONT: Pictures([encode_png(picture) for picture in pictures], decode_png)},
            )  # fmt: skip
            writer.add(prepare(frames, VideoRecipe(codec=codec)))
    return films


def test_png_pictures_are_those_that_were_written(tmp_path, rng) -> None:
    films = pictured(tmp_path / "dataset", "png", rng)
    frames = load_frames(tmp_path / "dataset")
    np.testing.assert_array_equal(frames.images[FRONT].permute(0, 2, 3, 1).numpy(), np.concatenate(films))
    assert frames.stats[FRONT]["mean"].shape == (3, 1, 1)


def test_videos_are_decoded_to_the_rows_that_they_belong_to(tmp_path, rng) -> None:
    pictured(tmp_path / "dataset", "h264", rng)
    files = DatasetFiles(tmp_path / "dataset")
    expected = np.concatenate([files.video(index, FRONT) for index in range(len(LENGTHS))])
    frames = load_frames(tmp_path / "dataset")
    np.testing.assert_array_equal(frames.images[FRONT].permute(0, 2, 3, 1).numpy(), expected)


@pytest.mark.slow
@pytest.mark.parametrize("use_videos", [True, False])
def test_a_dataset_that_lerobot_wrote_with_all_episodes_in_one_file(use_videos, tmp_path, rng) -> None:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    picture = {"dtype": "video" if use_videos else "image", "shape": (3, 64, 96)}
    features = {
        "observation.state": {"dtype": "float32", "shape": (1,), "names": None},
        "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        FRONT: picture | {"names": ["channels", "height", "width"]},
    }
    dataset: Any = LeRobotDataset.create(
        "lfd/test", fps=20, features=features, root=tmp_path / "dataset", use_videos=use_videos,
        rgb_encoder=RGBEncoderConfig(vcodec="h264"), video_backend="pyav",
    )  # fmt: skip
    for length in LENGTHS:
        for seen in film(rng, length):
            row = {"observation.state": rng.normal(size=1).astype("f4"), "action": rng.normal(size=2).astype("f4")}
            dataset.add_frame(row | {FRONT: seen, "task": "look"})
        dataset.save_episode()
    dataset.finalize()
    frames = load_frames(tmp_path / "dataset")
    read: Any = LeRobotDataset("lfd/test", root=tmp_path / "dataset", video_backend="pyav")
    assert [int(end) for end in frames.episodes[1]] == np.cumsum(LENGTHS).tolist()
    assert frames.units["action"] == ("", "")
    assert frames.intervention is None
    for index in range(len(read)):
        item = read[index]
        assert torch.equal(item[FRONT], frames.images[FRONT][index].float() / 255)
        assert torch.equal(item["observation.state"].view(1), frames.columns["observation.state"][index])


def test_pictures_stay_on_disk_where_they_are_not_asked_for(tmp_path, rng) -> None:
    pictured(tmp_path / "dataset", "png", rng)
    frames = load_frames(tmp_path / "dataset", images=False)
    assert frames.images == {}
    assert FRONT not in frames.stats


def test_more_pictures_than_half_of_the_memory_are_refused(tmp_path, rng, monkeypatch) -> None:
    pictured(tmp_path / "dataset", "png", rng)
    monkeypatch.setattr(lfd.data.pictures, "_memory", lambda: 900_000)
    with pytest.raises(DatasetError, match=r"26 frames with .*front of 96 x 64\) take 0.0 GB .*\[convert\] cameras"):
        load_frames(tmp_path / "dataset")


def test_missing_and_damaged_pictures_are_named(tmp_path, rng) -> None:
    pictured(tmp_path / "dataset", "h264", rng)
    video = sorted((tmp_path / "dataset" / "videos").rglob("*.mp4"))[1]
    others = sorted((tmp_path / "dataset" / "videos").rglob("*.mp4"))[0]
    video.write_bytes(others.read_bytes())  # 12 frames where 5 belong: the rest is nobody's
    assert len(load_frames(tmp_path / "dataset").images[FRONT]) == 26
    others.write_bytes(sorted((tmp_path / "dataset" / "videos").rglob("*.mp4"))[2].read_bytes())
    with pytest.raises(DatasetError, match=f"{FRONT} has 23 pictures of 26 frames"):
        load_frames(tmp_path / "dataset")
    video.write_bytes(video.read_bytes()[:100])
    with pytest.raises(DatasetError, match=r"file-001.mp4 cannot be read"):
        load_frames(tmp_path / "dataset")
