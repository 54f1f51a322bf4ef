"""Pictures to videos: frames go from memory to the encoder, no picture file in between."""

import io
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lfd.core.errors import DatasetError, RecipeError, UnknownName
from lfd.core.processes import ordinary_priority

PNG = "png"
CODECS = ("libsvtav1", "h264", "hevc")
WORST = {"libsvtav1": 63, "h264": 51, "hevc": 51, PNG: 63}
"""Codec to the highest crf that it knows."""


@dataclass(frozen=True, kw_only=True)
class VideoRecipe:
    """The `[video]` table of a file in `datasets/`."""

    codec: str = "libsvtav1"
    """Encoder of camera videos: libsvtav1 (LeRobot's own choice), h264 or hevc; png keeps pictures without loss."""
    crf: int = 30
    """Quality: lower is better and larger, 0 the best."""
    gop: int = 2
    """Pictures from one key frame to the next; training reads single frames faster when it is small."""
    preset: int = 12
    """Speed of libsvtav1, 0 the slowest to 13 the fastest."""

    def check(self, where: str) -> None:
        if self.codec not in (*CODECS, PNG):
            raise UnknownName(f"codec in {where}:", self.codec, (*CODECS, PNG))
        for key, low, high in (("crf", 0, WORST[self.codec]), ("gop", 1, 1000), ("preset", 0, 13)):
            if not low <= getattr(self, key) <= high:
                raise RecipeError(
                    f"{where} {key} = {getattr(self, key)}: must be from {low} to {high} with codec {self.codec}"
                )

    @property
    def options(self) -> dict[str, str]:
        """What the encoder is told."""
        common = {"g": str(self.gop), "crf": str(self.crf)}
        if self.codec == "libsvtav1":
            return common | {"preset": str(self.preset), "svtav1-params": "fast-decode=0:lp=1"}
        # with x264's mbtree the same small pictures make other bytes now and then
        own = {"h264": {"x264-params": "mbtree=0"}, "hevc": {"x265-params": "log-level=error:pools=none"}}
        return common | own[self.codec] | {"threads": "1"}  # episodes are encoded in parallel


def encode_video(pictures: Iterable[UInt8[np.ndarray, "H W 3"]], fps: int, recipe: VideoRecipe, where: str) -> bytes:
    """RGB pictures of one size as an MP4 file of yuv420p frames at a steady rate; messages call them `where`.

    Raises `DatasetError` for a size or rate that the codec does not take.
    """
    import av
    from av.error import FFmpegError

    os.environ.setdefault("SVT_LOG", "1")  # else libsvtav1 tells its settings for every video
    file, size, started = io.BytesIO(), (0, 0), False
    try:
        with av.open(file, "w", format="mp4") as output:
            stream: Any = None
            for picture in pictures:
                if stream is None:
                    size = picture.shape[:2]
                    stream = output.add_stream(recipe.codec, fps, options=recipe.options)
                    stream.height, stream.width = size
                    stream.pix_fmt = "yuv420p"
                packets = stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24"))
                if not started:  # the first picture starts the encoder's threads
                    started = True
                    ordinary_priority()
                output.mux(packets)
            output.mux(stream.encode())
    except FFmpegError as error:
        raise DatasetError(
            f"{where}: {recipe.codec} cannot encode pictures of {size[1]} x {size[0]} at {fps} Hz ({error}); h264 and "
            "hevc want even sizes, libsvtav1 at most 240 Hz, no codec very small pictures: change them, or keep them "
            'without loss with codec = "png" in [video]'
        ) from error
    return file.getvalue()


def decode_video(content: bytes) -> list[UInt8[np.ndarray, "H W 3"]]:
    """The frames of an MP4 file as RGB."""
    import av

    video = av.open(io.BytesIO(content), "r")
    try:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    finally:
        video.close()


def video_info(height: int, width: int, fps: int, recipe: VideoRecipe) -> dict[str, Any]:
    """LeRobot's description of a video feature."""
    canonical = {"libsvtav1": "av1"}.get(recipe.codec, recipe.codec)
    return {
        "video.height": height,
        "video.width": width,
        "video.codec": canonical,
        "video.pix_fmt": "yuv420p",
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
        "video.g": recipe.gop,
        "video.crf": recipe.crf,
        "video.preset": recipe.preset if recipe.codec == "libsvtav1" else None,
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": {},
        "is_depth_map": False,
    }
