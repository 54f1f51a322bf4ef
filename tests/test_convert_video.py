"""Pictures in datasets: as videos, which LeRobot decodes, and without loss."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from lfd.convert.dataset.dataset_files import DatasetFiles
from lfd.convert.dataset.video import VideoRecipe, decode_video, encode_video, video_info
from lfd.convert.to_lerobot import convert
from lfd.convert.verify import verify
from lfd.core.errors import DatasetError, LfdError, RecipeError, UnknownName, VerificationError
from lfd.record.png import decode_png
from tests.small_recordings import CAMERA, FEATURE, filmed, part, recipe, write_all
from tests.test_convert_lerobot_writer import doctor

FPS = 20


@pytest.fixture(scope="module")
def episodes(recorded) -> list:
    whole = filmed(recorded)
    return [part(whole, 0, 25), part(whole, 10, 40)]


@pytest.fixture(scope="module")
def recordings(episodes, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write_all(folder, *episodes)
    return folder


@pytest.fixture(scope="module", params=["h264", "libsvtav1", "hevc", "png"])
def dataset(request, recordings, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp(request.param) / request.param
    convert([recordings], out, recipe=recipe(video={"codec": request.param}, cameras=[CAMERA]))
    return out


def seen(episode: Any) -> list[np.ndarray]:
    return [decode_png(data) for data in episode.pictures[CAMERA]]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return 10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9))


def test_the_pictures_are_those_that_were_recorded(dataset, episodes) -> None:
    files = DatasetFiles(dataset)
    for index, episode in enumerate(episodes):
        recorded = seen(episode)[:-1]  # the last observation has no action
        if dataset.name == "png":
            stored = [decode_png(data) for data in files.read(index).pngs[FEATURE]]
            np.testing.assert_array_equal(stored, recorded)
        else:
            stored = files.video(index, FEATURE)
            assert len(stored) == len(episode)
            distances = np.array([[psnr(a, b) for b in recorded] for a in stored])
            assert distances.diagonal().min() > 28
            assert (distances.argmax(axis=1) == np.arange(len(stored))).all()
        described = files.episodes[index]
        if dataset.name != "png":
            assert described[f"videos/{FEATURE}/from_timestamp"] == 0
            assert described[f"videos/{FEATURE}/to_timestamp"] == pytest.approx(len(episode) / FPS)
    doctor(dataset)


@pytest.mark.slow
def test_lerobot_decodes_the_frame_of_every_row(dataset, episodes) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    window = {FEATURE: [-1 / FPS, 0.0, 1 / FPS]}
    opened: Any = LeRobotDataset("lfd/x", root=dataset, video_backend="pyav", delta_timestamps=window)
    at = 0
    for episode in episodes:
        recorded = seen(episode)
        for t in (1, 7, len(episode) - 2):
            three = opened[at + t][FEATURE].numpy().transpose(0, 2, 3, 1) * 255
            assert float(opened[at + t]["timestamp"]) == pytest.approx(t / FPS)
            for decoded, row in zip(three, (t - 1, t, t + 1), strict=True):
                assert psnr(decoded, recorded[row]) > (60 if dataset.name == "png" else 28)
                others = [psnr(decoded, picture) for picture in recorded]
                assert int(np.argmax(others)) == row
        at += len(episode)


@pytest.mark.slow
@pytest.mark.parametrize("codec", ["h264", "libsvtav1"])
def test_videos_are_described_as_lerobot_describes_them(codec, tmp_path) -> None:
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.video_utils import get_video_info

    wanted = VideoRecipe(codec=codec)
    pictures = [np.full((64, 96, 3), 10 * i, np.uint8) for i in range(6)]
    (tmp_path / "a.mp4").write_bytes(encode_video(pictures, FPS, wanted, "a"))
    encoder = RGBEncoderConfig(vcodec=codec, g=wanted.gop, crf=wanted.crf)
    assert video_info(64, 96, FPS, wanted) == get_video_info(tmp_path / "a.mp4", encoder)


@pytest.mark.parametrize("codec", ["h264", "libsvtav1", "hevc"])
@pytest.mark.parametrize("fps", [1, 20, 30, 240])
def test_frame_t_stands_at_t_over_fps_and_key_frames_are_no_further_apart_than_asked(codec, fps, tmp_path) -> None:
    pictures = [np.full((64, 64, 3), 100 + t, np.uint8) for t in range(9)]
    path = tmp_path / "a.mp4"
    path.write_bytes(encode_video(pictures, fps, VideoRecipe(codec=codec, gop=3), "a"))
    video = av.open(str(path))
    frames = list(video.decode(video=0))
    assert video.streams.video[0].average_rate == Fraction(fps)
    video.close()
    assert [float(frame.time or 0) for frame in frames] == pytest.approx([t / fps for t in range(9)], abs=1e-4)
    keys = [t for t, frame in enumerate(frames) if frame.key_frame]
    assert keys[0] == 0
    assert max(np.diff([*keys, 9])) == 3


def swap(dataset: Path, copy: Path, change: Any) -> Path:
    """A copy of a dataset whose first video has other frames."""
    shutil.copytree(dataset, copy)
    files = DatasetFiles(copy)
    path = sorted((copy / "videos").rglob("*.mp4"))[0]
    frames = decode_video(path.read_bytes())
    path.write_bytes(encode_video(change(list(frames)), files.fps, VideoRecipe(codec=dataset.name, crf=5), "a"))
    return copy


def test_verification_finds_pictures_that_are_not_those_of_their_rows(dataset, recordings, tmp_path) -> None:
    if dataset.name == "png":
        pytest.skip("kept to the bit, see below")

    def neighbours(frames: list) -> list:
        frames[8], frames[9] = frames[9], frames[8]
        return frames

    def far(frames: list) -> list:
        frames[2], frames[20] = frames[20], frames[2]
        return frames

    def late(frames: list) -> list:
        return [frames[0], *frames[:-1]]

    def early(frames: list) -> list:
        return [*frames[1:], frames[-1]]

    assert verify(dataset, [recordings]) > 0
    assert verify(swap(dataset, tmp_path / "again", lambda frames: frames), [recordings]) > 0
    for change in (neighbours, far, late, early, lambda frames: frames[::-1]):
        broken = swap(dataset, tmp_path / change.__name__.strip("<>"), change)
        with pytest.raises(VerificationError, match=rf"as episode 0: picture \d+ of {FEATURE} is another than in"):
            verify(broken, [recordings])
    short = swap(dataset, tmp_path / "short", lambda frames: frames[:-1])
    with pytest.raises(VerificationError, match=f"number of pictures of {FEATURE}: the dataset says 24, the rec.* 25"):
        verify(short, [recordings])


def test_verification_finds_a_pixel(recordings, tmp_path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from lfd.record.png import encode_png

    out = tmp_path / "dataset"
    convert([recordings], out, recipe=recipe(video={"codec": "png"}, cameras=[CAMERA]))
    (path,) = (out / "data").rglob("*.parquet")
    table = pq.read_table(path)
    rows = table[FEATURE].to_pylist()
    picture = decode_png(rows[30]["bytes"]).copy()
    picture[3, 4, 1] += 1
    rows[30]["bytes"] = encode_png(picture)
    at = table.schema.get_field_index(FEATURE)
    pq.write_table(table.set_column(at, FEATURE, pa.array(rows, table.schema.field(FEATURE).type)), path)
    with pytest.raises(VerificationError, match=f"as episode 1: picture 5 of {FEATURE} is another than in the rec"):
        verify(out, [recordings])


def test_a_video_file_that_is_damaged_or_gone_is_named(recordings, tmp_path) -> None:
    out = tmp_path / "dataset"
    convert([recordings], out, recipe=recipe(video={"codec": "h264"}, cameras=[CAMERA]))
    path = sorted((out / "videos").rglob("*.mp4"))[0]
    whole = path.read_bytes()
    for damaged in (whole[:50], b"", bytes(len(whole))):
        path.write_bytes(damaged)
        with pytest.raises(LfdError, match=r"file-000.mp4 cannot be read"):
            verify(out, [recordings])
    path.unlink()
    with pytest.raises(LfdError, match=r"file-000.mp4 cannot be read"):
        verify(out, [recordings])


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_a_size_that_the_codec_does_not_take_is_said_with_the_recording(codec, recorded, tmp_path) -> None:
    write_all(tmp_path / "a", filmed(part(recorded, 0, 4), 63, 95))
    with pytest.raises(
        DatasetError, match=rf"000.mcap: {FEATURE}: {codec} cannot encode pictures of 95 x 63 at 20 Hz .*codec ="
    ):
        convert([tmp_path / "a"], tmp_path / "out", recipe=recipe(video={"codec": codec}, cameras=[CAMERA]))
    done = convert([tmp_path / "a"], tmp_path / "out", recipe=recipe(video={"codec": "png"}, cameras=[CAMERA]))
    assert done.episodes == 1


@pytest.mark.parametrize("codec", ["h264", "png"])
def test_pictures_that_change_their_size_are_refused_with_the_time(codec, recorded, tmp_path) -> None:
    from dataclasses import replace

    small, large = (filmed(part(recorded, 0, 6), *size).pictures[CAMERA] for size in ((64, 64), (64, 96)))
    mixed = replace(part(recorded, 0, 6), pictures={CAMERA: small[:3] + large[3:]})
    write_all(tmp_path / "a", mixed)
    with pytest.raises(
        DatasetError, match=r"images.agentview changes its size from 64 x 64 to 96 x 64 in row 3 \(0.150"
    ):
        convert([tmp_path / "a"], tmp_path / "out", recipe=recipe(video={"codec": codec}, cameras=[CAMERA]))
    write_all(tmp_path / "b", filmed(part(recorded, 0, 6), 64, 64), filmed(part(recorded, 0, 6), 64, 96))
    with pytest.raises(DatasetError, match=f"000001.mcap does not go with .*000000.mcap: feature {FEATURE} is"):
        convert([tmp_path / "b"], tmp_path / "out", recipe=recipe(video={"codec": codec}, cameras=[CAMERA]))


def test_settings_that_no_encoder_has() -> None:
    with pytest.raises(UnknownName, match="unknown codec in here: 'av1'; known: h264, hevc, libsvtav1, png"):
        VideoRecipe(codec="av1").check("here")
    with pytest.raises(RecipeError, match="here crf = 60: must be from 0 to 51 with codec h264"):
        VideoRecipe(codec="h264", crf=60).check("here")
    VideoRecipe(crf=60).check("here")
    with pytest.raises(RecipeError, match="here gop = 0: must be from 1 to 1000"):
        VideoRecipe(gop=0).check("here")


def test_encoders_say_nothing() -> None:
    """In a process of its own: LeRobot lets FFmpeg speak."""
    code = (
        "import numpy as np\nfrom lfd.convert.dataset.video import *\n"
        "pictures = [np.zeros((64, 64, 3), np.uint8)] * 3\n"
        "for codec in CODECS: encode_video(pictures, 20, VideoRecipe(codec=codec), 'a')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


@pytest.mark.parametrize("codec", ["h264", "hevc", "libsvtav1"])
def test_the_same_pictures_make_the_same_bytes(codec) -> None:
    noise = np.random.default_rng(0)
    pictures = [np.clip(noise.normal(128 + 4 * t, 20, (64, 96, 3)), 0, 255).astype(np.uint8) for t in range(30)]
    made = {encode_video(pictures, 20, VideoRecipe(codec=codec), "a") for _ in range(60 if codec == "h264" else 5)}
    assert len(made) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="libsvtav1 asks for real-time priority on Linux")
def test_an_encoder_does_not_keep_the_machine_to_itself() -> None:
    """It takes real-time priority as root, for its threads and for its caller, for good."""
    seen: list[set[int]] = []

    def pictures() -> Iterator[np.ndarray]:
        for value in range(3):
            seen.append({os.sched_getscheduler(int(task.name)) for task in Path("/proc/self/task").iterdir()})
            yield np.full((64, 64, 3), value, np.uint8)

    encode_video(pictures(), FPS, VideoRecipe(codec="libsvtav1"), "episode 0")
    assert set().union(*seen[1:]) == {os.SCHED_OTHER}
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
