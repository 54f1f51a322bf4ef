"""Pictures to videos: frames go from memory to the encoder, no picture file in between."""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lfd.core.errors import RecipeError, UnknownName

PNG = "png"
CODECS = ("libsvtav1", "h264", "hevc")


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
        for key, low, high in (("crf", 0, 63), ("gop", 1, 1000), ("preset", 0, 13)):
            if not low <= getattr(self, key) <= high:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be from {low} to {high}")

    @property
    def options(self) -> dict[str, str]:
        """What the encoder is told."""
        common = {"g": str(self.gop), "crf": str(self.crf)}
        if self.codec == "libsvtav1":
            return common | {"preset": str(self.preset), "svtav1-params": "fast-decode=0:lp=1"}
        return common | {"threads": "1"}  # episodes are encoded in parallel


def encode_video(pictures: Iterable[UInt8[np.ndarray, "H W 3"]], fps: int, recipe: VideoRecipe) -> bytes:
    """RGB pictures as an MP4 file of yuv420p frames at a steady rate."""
    import av

    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as output:
        stream: Any = None
        for picture in pictures:
            if stream is None:
                stream = output.add_stream(recipe.codec, fps, options=recipe.options)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            output.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
        output.mux(stream.encode())
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
        "video.g": recipe.gop,
        "video.crf": recipe.crf,
        "has_audio": False,
        "is_depth_map": False,
    }
