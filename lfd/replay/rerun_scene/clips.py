"""All of a clip as entities: shapes, motion, paths, plans, forces, curves, states, pictures."""

import numpy as np
import rerun as rr
from jaxtyping import Float

from lfd.replay.clip import EXPERT, GRIPPERS, POLICY, SOLVED, UNSOLVED, Clip, entity
from lfd.replay.rerun_scene.models import log_motion, log_scene, log_shapes

BLUE, ORANGE, GREEN, RED, AMBER, GREY, VIOLET = (
    *((37, 99, 235), (234, 88, 12), (22, 163, 74), (220, 38, 38), (245, 158, 11), (107, 114, 128), (124, 58, 237)),
)
OUTCOME_COLORS = {True: GREEN, False: RED, None: BLUE}
"""Of the gripper's path, by success."""
PATH_COLORS = {"a": BLUE, "b": ORANGE, "planned": GREEN}
OBJECT_COLOR = ORANGE
PLAN_COLORS = {"planned": GREY, "deformed": ORANGE, "new": VIOLET}
STATE_COLORS = {SOLVED: GREEN, UNSOLVED: GREY, EXPERT: AMBER, POLICY: BLUE}
BESIDE_COLORS = (BLUE, ORANGE, GREEN, VIOLET, RED, AMBER, GREY)
"""Of curves that lie over one another, by clip."""
M_PER_N = 0.01
"""Length of a force's arrow."""
TICK_S = 1e-6
"""Less than any step: times are rounded to it when they are looked up."""


def log_clip(recording: rr.RecordingStream, clip: Clip, *, root: str = "", beside: int | None = None) -> None:
    """Log a clip below `root`, which ends in a slash if it is not empty; `beside` is its number among others."""
    if clip.model is not None and clip.qpos is not None:
        log_shapes(recording, clip.model, root)
        log_motion(recording, clip.model, clip.qpos, clock_of(clip.times), root)
    log_scene(recording, clip.shapes, root)
    _log_paths(recording, clip, root)
    _log_plans(recording, clip, root)
    _log_arrows(recording, clip, root)
    _log_curves(recording, clip, root, beside)
    _log_states(recording, clip, root)
    _log_pictures(recording, clip, root)
    if clip.about:
        table = "\n".join(["| | |", "| --- | --- |", *(f"| **{key}** | {said} |" for key, said in clip.about.items())])
        recording.log(f"{root}about", rr.TextDocument(table, media_type=rr.MediaType.MARKDOWN), static=True)


def clock_of(times: Float[np.ndarray, "N"]) -> list[rr.TimeColumn]:
    """The two time lines: seconds since the first row, and the number of the row."""
    return [rr.TimeColumn("time", duration=times), rr.TimeColumn("step", sequence=np.arange(len(times)))]


def _clock_within(clip: Clip, times: Float[np.ndarray, "M"]) -> list[rr.TimeColumn]:
    """The time lines for things that have times of their own."""
    steps = np.searchsorted(clip.times, times - TICK_S)
    return [rr.TimeColumn("time", duration=times), rr.TimeColumn("step", sequence=steps)]


def _log_paths(recording: rr.RecordingStream, clip: Clip, root: str) -> None:
    for name, path in clip.positions.items():
        color = OUTCOME_COLORS[clip.success] if name in GRIPPERS else PATH_COLORS.get(name, OBJECT_COLOR)
        way = f"{root}world/paths/{entity(name)}"
        recording.log(way, rr.LineStrips3D([path], colors=[color], radii=[0.002]), static=True)
        columns = rr.Points3D.columns(positions=path)
        recording.send_columns(f"{way}/now", indexes=clock_of(clip.times), columns=columns)
        recording.log(f"{way}/now", rr.Points3D.from_fields(radii=[0.006], colors=[color]), static=True)
    for name, pieces in clip.pieces.items():
        strips = rr.LineStrips3D(pieces, colors=[AMBER], radii=[0.005])
        recording.log(f"{root}world/paths/{name}", strips, static=True)


def _log_plans(recording: rr.RecordingStream, clip: Clip, root: str) -> None:
    """Ways by a plan, each as long as it holds."""
    for name, ways in clip.plans.items():
        if not ways:
            continue
        look = rr.LineStrips3D.from_fields(colors=[PLAN_COLORS.get(name, OBJECT_COLOR)], radii=[0.004])
        recording.log(f"{root}world/plans/{name}", look, static=True)
        recording.send_columns(
            f"{root}world/plans/{name}",
            indexes=_clock_within(clip, np.array([time_s for time_s, _ in ways])),
            columns=rr.LineStrips3D.columns(strips=[way for _, way in ways]),
        )


def _log_arrows(recording: rr.RecordingStream, clip: Clip, root: str) -> None:
    for name, arrow in clip.arrows.items():
        force = f"{root}world/arrows/{name}"
        columns = rr.Arrows3D.columns(origins=arrow.origins, vectors=M_PER_N * arrow.forces)
        recording.send_columns(force, indexes=clock_of(clip.times), columns=columns)
        recording.log(force, rr.Arrows3D.from_fields(colors=[RED], radii=[0.008]), static=True)


def _log_curves(recording: rr.RecordingStream, clip: Clip, root: str, beside: int | None) -> None:
    for path, curve in clip.curves.items():
        look = rr.SeriesLines(names=list(curve.names))
        if beside is not None and len(curve.names) == 1:
            look = rr.SeriesLines(names=[clip.title], colors=[BESIDE_COLORS[beside % len(BESIDE_COLORS)]])
        recording.log(f"{root}{path}", look, static=True)
        clock = clock_of(clip.times) if curve.times is None else _clock_within(clip, curve.times)
        recording.send_columns(f"{root}{path}", indexes=clock, columns=rr.Scalars.columns(scalars=curve.values))


def _log_states(recording: rr.RecordingStream, clip: Clip, root: str) -> None:
    known = list(STATE_COLORS)
    look = rr.StateConfiguration(values=known, labels=known, colors=list(STATE_COLORS.values()))
    for name, changes in clip.states.items():
        path = f"{root}states/{name.replace(' ', '_')}"
        recording.log(path, look, static=True)
        times = np.array([time_s for time_s, _ in changes])
        columns = rr.StateChange.columns(state=[state for _, state in changes])
        recording.send_columns(path, indexes=_clock_within(clip, times), columns=columns)


def _log_pictures(recording: rr.RecordingStream, clip: Clip, root: str) -> None:
    for path, pictures in clip.pictures.items():
        is_jpeg = pictures[0].startswith(b"\xff\xd8")
        media = "image/jpeg" if is_jpeg else "image/png"
        recording.log(f"{root}{path}", rr.EncodedImage.from_fields(media_type=media), static=True)
        columns = rr.EncodedImage.columns(blob=[np.frombuffer(data, np.uint8) for data in pictures])
        recording.send_columns(f"{root}{path}", indexes=clock_of(clip.times), columns=columns)
    for path, video in clip.videos.items():
        film = rr.AssetVideo(contents=video.content, media_type="video/mp4")
        recording.log(f"{root}{path}", film, static=True)
        stamps = np.array(film.read_frame_timestamps_nanos())[video.frames]
        columns = rr.VideoFrameReference.columns_nanos(stamps)
        recording.send_columns(f"{root}{path}", indexes=clock_of(clip.times), columns=columns)
