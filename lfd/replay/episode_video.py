"""The part of a dataset's video that shows one episode, cut out without encoding it again."""

import io
from pathlib import Path

import numpy as np

from lfd.core.errors import DatasetError
from lfd.replay.clip import Video


def episode_video(path: Path, begin_s: float, rows: int, fps: float) -> Video:
    """The `rows` pictures of a video from the time `begin_s` [s] on, at `fps` pictures a second.

    What comes between the last key frame and the first picture is kept, since the pictures are decoded from there.
    Raises `DatasetError` for a file that is no video, or that ends before the episode.
    """
    from av.error import FFmpegError

    try:
        return _cut(path, begin_s, rows, fps)
    except (FFmpegError, OSError) as error:
        raise DatasetError(f"{path} is no video that can be read ({error}); convert the recordings again") from error


def _cut(path: Path, begin_s: float, rows: int, fps: float) -> Video:
    import av

    half = 0.5 / fps
    target, shown = io.BytesIO(), []
    with av.open(str(path)) as source, av.open(target, "w", format="mp4") as cut:
        film = source.streams.video[0]
        assert film.time_base is not None
        tick = float(film.time_base)
        copy = cut.add_stream_from_template(film, opaque=True)  # no encoder is needed
        source.seek(max(0, int((begin_s + half / 2) / tick)), stream=film)
        end_s, base = begin_s + (rows - 1) / fps + half, None
        for packet in source.demux(film):
            if packet.pts is None or packet.dts is None:
                continue
            if packet.is_keyframe and packet.pts * tick > end_s:
                break
            base = packet.dts if base is None else base
            shown.append(packet.pts * tick)
            packet.pts, packet.dts, packet.stream = packet.pts - base, packet.dts - base, copy
            cut.mux(packet)
    times = np.sort(np.array(shown))
    wanted = begin_s + np.arange(rows) / fps
    frames = np.searchsorted(times, wanted - half)
    if not len(times) or frames[-1] >= len(times) or abs(times[frames[-1]] - wanted[-1]) > half:
        raise DatasetError(f"{path} ends before the last picture of the episode; convert the recordings again")
    return Video(target.getvalue(), frames)
