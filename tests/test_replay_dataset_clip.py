"""Datasets of this and of other projects as clips."""

from typing import Any

import av
import numpy as np
import pytest

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.dataset.video import decode_video
from lfd.core.errors import DatasetError
from lfd.replay.clip import Video
from lfd.replay.dataset_clip import dataset_clip
from lfd.replay.episode_video import episode_video
from lfd.replay.rerun_scene.outputs import Sheet, write_file
from tests.test_data_pictures import FRONT, LENGTHS, pictured
from tests.test_replay import columns
from tests.test_replay_rerun_scene import verified


def shown(video: Video) -> np.ndarray:
    """The picture of each row."""
    decoded = decode_video(video.content)
    return np.array([decoded[frame] for frame in video.frames])


@pytest.mark.parametrize("codec", ["h264", "libsvtav1"])
def test_the_part_of_a_video_that_is_cut_out_is_the_episode(codec, tmp_path, rng) -> None:
    pictured(tmp_path / "dataset", codec, rng)
    files = DatasetFiles(tmp_path / "dataset")
    for index in range(len(LENGTHS)):
        clip = dataset_clip(tmp_path / "dataset", index)
        np.testing.assert_array_equal(shown(clip.videos["cameras/front"]), files.video(index, FRONT))
        assert clip.curves["plots/action"].values.shape == (LENGTHS[index], 2)


def joined(path, rng) -> list[np.ndarray]:
    """A film of 40 pictures at 20 Hz with a key frame now and then, and others between that look both ways."""
    pictures = [np.full((64, 96, 3), 6 * number, np.uint8) for number in range(40)]
    with av.open(str(path), "w") as film:
        stream = film.add_stream("h264", 20, options={"g": "12", "bf": "2"})
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for picture in pictures:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        film.mux(stream.encode())
    return decode_video(path.read_bytes())


def test_an_episode_that_begins_between_key_frames_is_cut_from_the_one_before(tmp_path, rng) -> None:
    pictures = joined(tmp_path / "film.mp4", rng)
    for begin, rows in ((0, 40), (17, 9), (30, 10), (12, 1)):
        video = episode_video(tmp_path / "film.mp4", begin / 20, rows, 20.0)
        np.testing.assert_array_equal(shown(video), pictures[begin : begin + rows])
    with pytest.raises(DatasetError, match="ends before the last picture"):
        episode_video(tmp_path / "film.mp4", 35 / 20, 9, 20.0)
    (tmp_path / "no.mp4").write_bytes(b"no film")
    with pytest.raises(DatasetError, match="is no video that can be read"):
        episode_video(tmp_path / "no.mp4", 0.0, 3, 20.0)


def test_films_and_pictures_arrive_in_rerun(tmp_path, rng) -> None:
    for codec, component in (("h264", "VideoFrameReference:timestamp"), ("png", "EncodedImage:blob")):
        pictured(tmp_path / codec, codec, rng)
        clip = dataset_clip(tmp_path / codec, 1)
        write_file([Sheet("x", (clip,))], tmp_path / f"{codec}.rrd", overwrite=False)
        verified(tmp_path / f"{codec}.rrd")
        batches = columns(tmp_path / f"{codec}.rrd")["/cameras/front"]
        assert max(b.num_rows for b in batches if any(n.endswith(component) for n in b.schema.names)) == LENGTHS[1]


@pytest.mark.slow
def test_a_dataset_of_another_project_is_shown_as_far_as_its_features_say(tmp_path, rng, lfd_fails) -> None:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    motors = ["shoulder_pan.pos", "gripper.pos"]
    features = {
        "observation.state.follower": {"dtype": "float32", "shape": (2,), "names": motors},
        "observation.force": {"dtype": "float32", "shape": (1,), "names": None},
        "observation.map": {"dtype": "float32", "shape": (9, 9), "names": None},
        "action": {"dtype": "float32", "shape": (2,), "names": {"motors": motors}},
        "pressed": {"dtype": "bool", "shape": (1,), "names": None},
        "observation.images.wrist cam": {
            "dtype": "video",
            "shape": (64, 96, 3),
            "names": ["height", "width", "channels"],
        },
    }
    dataset: Any = LeRobotDataset.create(
        "another/project", fps=30, features=features, root=tmp_path / "theirs", robot_type="so100",
        rgb_encoder=RGBEncoderConfig(vcodec="h264"), video_backend="pyav",
    )  # fmt: skip
    rows = {
        name: rng.normal(size=(8, *told["shape"])).astype("f4") for name, told in features.items() if name != "pressed"
    }
    for _ in range(2):
        for t in range(8):
            row = {name: values[t] for name, values in rows.items() if "images" not in name}
            row |= {
                "pressed": np.array([t > 3]),
                "observation.images.wrist cam": np.full((64, 96, 3), 20 * t, np.uint8),
            }
            dataset.add_frame({**row, "task": "stack it"})
        dataset.save_episode()
    dataset.finalize()
    clip = dataset_clip(tmp_path / "theirs", 1)
    assert clip.model is None
    assert clip.success is None
    assert clip.curves["plots/observation.state.follower"].names == tuple(motors)
    assert clip.curves["plots/action"].names == tuple(motors)
    np.testing.assert_allclose(clip.curves["plots/action"].values, rows["action"])
    np.testing.assert_array_equal(clip.curves["plots/pressed"].values[:, 0], np.arange(8) > 3)
    assert not any("map" in path for path in clip.curves)
    assert clip.about["not shown"].startswith("observation.map")
    assert clip.about["task"] == "stack it"
    assert np.ptp(shown(clip.videos["cameras/wrist_cam"]).mean(axis=(1, 2, 3))) > 100
    write_file([Sheet("x", (clip,))], tmp_path / "x.rrd", overwrite=False)
    verified(tmp_path / "x.rrd")
    assert "episodes 0 to 1, not 5" in lfd_fails(
        "replay", tmp_path / "theirs", "--episode", "5", "--save", tmp_path / "y.rrd"
    )
