"""Pictures in messages of other programs as RGB: raw ones, and compressed ones as PNG or JPEG."""

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lfd.convert.foreign.message_decoding import UNDECODABLE, decode_message, decoder_of, log_time
from lfd.convert.foreign.message_fields import stamp_of
from lfd.core.errors import RecordingError
from lfd.record.mcap_file import Topic

RAW = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
"""Encoding of a raw picture to its bytes a pixel and which of them are red, green and blue."""
PNG, JPEG, JPEG_END = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\xff\xd9"


@dataclass(frozen=True)
class MessagePictures:
    """Decodes the messages of one topic, given as bytes, to RGB pictures of one size.

    Raises `RecordingError` with file, topic and stamp for a message that holds no picture, or one of another size.
    """

    topic: Topic
    where: str
    """File and topic, as messages name them."""
    shape: tuple[int, ...] = ()
    """Height, width and 3 of the first picture."""

    def __call__(self, data: bytes) -> UInt8[np.ndarray, "H W 3"]:
        """The RGB picture in a message."""
        decoder = decoder_of(self.topic, self.where)
        message = decode_message(decoder, data, self.where, 0)
        try:
            picture = picture_in(message, decoder.members(message))
        except UNDECODABLE as error:
            raise RecordingError(
                f"{self.where}, message with stamp {log_time(stamp_of(message, decoder))}: {error}; "
                "leave the recording out (--skip-bad)"
            ) from error
        if self.shape and picture.shape != self.shape:
            raise RecordingError(
                f"{self.where}, message with stamp {log_time(stamp_of(message, decoder))}: a picture of "
                f"{picture.shape[1]} x {picture.shape[0]}, the first has {self.shape[1]} x {self.shape[0]}; "
                "pictures of a feature have one size: leave the recording out (--skip-bad)"
            )
        return picture


def holds_picture(members: tuple[str, ...]) -> bool:
    """Whether a message with these members is a picture."""
    return {"encoding", "data", "step"} <= set(members) or {"format", "data"} <= set(members)


def picture_in(message: Any, members: tuple[str, ...]) -> UInt8[np.ndarray, "H W 3"]:
    """The RGB picture in sensor_msgs Image or CompressedImage, foxglove RawImage or CompressedImage.

    Raises `ValueError` for a picture that ends too soon or is encoded in another way.
    """
    if not holds_picture(members):
        raise ValueError(f"no picture: the message has the fields {', '.join(members)}")
    # JSON carries bytes as base64
    data = base64.b64decode(message.data, validate=True) if isinstance(message.data, str) else bytes(message.data)
    return _compressed(data, str(message.format)) if "format" in members else _raw(message, data)


def _raw(message: Any, data: bytes) -> UInt8[np.ndarray, "H W 3"]:
    """Rows of `step` bytes, of which the first width * bytes a pixel count."""
    if message.encoding not in RAW:
        raise ValueError(f"the picture is encoded as {message.encoding!r}; lfd reads {', '.join(RAW)}, PNG and JPEG")
    size, colours = RAW[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    if min(height, width) < 1 or step < width * size or len(data) < step * (height - 1) + width * size:
        raise ValueError(
            f"a picture of {width} x {height} {message.encoding} with a step of {step} does not fit {len(data)} bytes"
        )
    step = step if height > 1 else width * size
    padded = np.zeros(step * height, np.uint8)  # the last row may come without its padding
    padded[: len(data)] = np.frombuffer(data, np.uint8)[: step * height]
    pixels = padded.reshape(height, step)[:, : width * size].reshape(height, width, size)
    return np.ascontiguousarray(pixels[..., colours])


def _compressed(data: bytes, told: str) -> UInt8[np.ndarray, "H W 3"]:
    import cv2

    if "compressedDepth" in told or not data.startswith((PNG, JPEG)):
        raise ValueError(f"the picture's format is {told!r}, beginning with {data[:4].hex()}; lfd reads PNG and JPEG")
    # OpenCV fills what is missing of a JPEG with grey
    if data.startswith(JPEG) and JPEG_END not in data[-64:]:
        raise ValueError("the JPEG ends too soon")
    # the camera's rows, whatever EXIF says of turning them
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ValueError(f"the {told or 'compressed picture'} cannot be decoded: {error.err}") from error
    if picture is None:
        raise ValueError(f"the {told or 'compressed picture'} cannot be decoded")
    if picture.dtype != np.uint8:
        raise ValueError(f"the picture has {8 * picture.itemsize} bits a colour; lfd reads 8")
    return np.ascontiguousarray(picture[..., ::-1])
