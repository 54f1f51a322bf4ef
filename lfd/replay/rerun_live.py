"""Scenes and curves that move in Rerun's viewer while something goes on.

What is served is served by `lfd.replay.viewer_process`.
"""

import time
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lfd.core.rotations import xyzw_from_wxyz
from lfd.replay.rerun_scene.blueprints import panels, scene_view
from lfd.replay.rerun_scene.models import body_name, log_shapes, seen_bodies
from lfd.replay.viewer_process import serving

__all__ = ["RerunBoard", "RerunScene", "serving"]

EYE = (1.4, -0.35, 1.45)
"""From where the person looks [m]: nearly opposite to the robot, so that away from them is towards it."""
IN_A_ROW = 2
"""Views of worlds beside each other."""


class RerunScene:
    """Sends a model to a viewer and moves its bodies; time is that of the clock since the beginning.

    Without a `recording` to draw into, below a `root` that ends in a slash, it makes one of its own.
    """

    def __init__(
        self, source: str, *, recording: rr.RecordingStream | None = None, root: str = "", began: float | None = None
    ):
        """`began` is when its time was 0, by `time.monotonic` [s]; now, if it is not given."""
        self._root, self._began = root, time.monotonic() if began is None else began
        self._recording = recording or _connected(source, "live", rrb.Blueprint(scene_view(EYE), *_panels("time")))

    def load(self, model: mujoco.MjModel) -> None:
        """Show another model, which takes the place of one with the same names."""
        log_shapes(self._recording, model, self._root)
        self._bodies = np.array(seen_bodies(model), dtype=int)
        self._entities = [f"{self._root}world/{body_name(model, int(body))}" for body in self._bodies]
        self._shown = np.full((len(self._bodies), 7), np.nan)

    def move(self, data: mujoco.MjData) -> None:
        """Show the bodies where they are in `data`; those that stayed need no message."""
        places = np.hstack([data.xpos[self._bodies], data.xquat[self._bodies]])
        self._recording.set_time("time", duration=time.monotonic() - self._began)
        translations = rr.components.Translation3DBatch(places[:, :3]).as_arrow_array()  # one by one it takes longer
        turns = rr.components.RotationQuatBatch(xyzw_from_wxyz(places[:, 3:])).as_arrow_array()
        for row in np.flatnonzero((places != self._shown).any(axis=1)):
            pose = rr.Transform3D.from_fields(translation=translations[row : row + 1], quaternion=turns[row : row + 1])
            self._recording.log(self._entities[row], pose)
        self._shown = places

    def close(self) -> None:
        """Send what is still waiting."""
        self._recording.flush()
        self._recording.disconnect()


class RerunBoard:
    """Curves that grow, and scenes of several worlds beside them."""

    def __init__(
        self, source: str, title: str, plots: Sequence[tuple[str, ...]], *, scenes: int = 0, clock: str = "time"
    ):
        """Each of `plots` names the curves of one view; `clock` is what they are drawn over."""
        self._source, self._clock, self._began = source, clock, time.monotonic()
        charts = [
            rrb.TimeSeriesView(name=" ".join(names), origin="/", contents=[f"plots/{name}" for name in names])
            for names in plots
        ]
        views = [scene_view(EYE, root=_root(place), name=f"world {place}") for place in range(scenes)]
        column = rrb.Vertical(*charts)
        body = rrb.Horizontal(rrb.Grid(*views, grid_columns=min(IN_A_ROW, scenes)), column, column_shares=[2, 1])
        self._recording = _connected(source, title, rrb.Blueprint(body if views else column, *_panels(clock)))
        for name in (name for names in plots for name in names):
            self._recording.log(f"plots/{name}", rr.SeriesLines(names=[name]), static=True)

    def scene(self, place: int) -> RerunScene:
        """Where the world number `place` is drawn."""
        return RerunScene(self._source, recording=self._recording, root=_root(place), began=self._began)

    def tell(self, values: Mapping[str, float], step: int | None = None) -> None:
        """Let curves go on: at a step of the clock, or now."""
        if step is None:
            self._recording.set_time(self._clock, duration=time.monotonic() - self._began)
        else:
            self._recording.set_time(self._clock, sequence=step)
        for name, value in values.items():
            self._recording.log(f"plots/{name}", rr.Scalars([value]))

    def close(self) -> None:
        """Send what is still waiting."""
        self._recording.flush()
        self._recording.disconnect()


def _root(place: int) -> str:
    return f"world_{place}/"


def _panels(clock: str) -> tuple[rrb.BlueprintPart, ...]:
    """Time goes on with what arrives."""
    _, *others = panels()
    return rrb.TimePanel(timeline=clock, state="collapsed", play_state="following"), *others


def _connected(source: str, title: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    recording = rr.RecordingStream(f"lfd_{title.replace(' ', '_')}")
    recording.connect_grpc(source)
    recording.send_recording_name(title)
    recording.send_blueprint(blueprint)
    return recording
