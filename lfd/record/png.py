"""Pictures as PNG: no number of a recorded picture is lost."""

import numpy as np
from jaxtyping import UInt8

from lfd.core.errors import RecordingError


def encode_png(picture: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """An RGB picture as PNG, compressed a little and fast."""
    import cv2

    _, encoded = cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return encoded.tobytes()


def decode_png(data: bytes) -> UInt8[np.ndarray, "H W 3"]:
    """The RGB picture in a PNG.

    Raises `RecordingError` when it is none.
    """
    import cv2

    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise RecordingError("a picture in the recording cannot be decoded as PNG; leave the file out")
    return np.ascontiguousarray(picture[..., ::-1])
