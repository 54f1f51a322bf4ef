"""What is seen of clips, and where: one layout for each kind of clip, and one for clips side by side."""

from collections.abc import Sequence

import mujoco
import rerun.blueprint as rrb

from lfd.replay.clip import WHO_ACTS, Clip

FIRST_PLOTS = {
    "correction": ("plots/weights", "plots/push"),
    "interaction": ("plots/belief", "plots/belief_entropy"),
    "shared_control": ("plots/action/applied", "plots/action/expert"),
    "episode": ("plots/action/applied", "plots/joints/position"),
    "features": ("plots/action", "plots/observation.state"),
}
"""What is seen at once, by kind of clip; the last are datasets of other projects, whose names mean what they mean."""
EYE = (1.05, -0.85, 1.45)
"""From where a clip is seen [m]: the robot's front and right."""
LOOK_AT = (-0.15, 0.05, 0.9)
"""Where that eye looks [m]."""
ROBOT_CAR, BEHIND_CAR, AHEAD_OF_CAR = "world/robot_car", (-16.0, -9.0, 10.0), (4.0, 1.5, 0.0)
"""The robot as a car, from where it is followed, and where that eye looks, in its frame [m]."""
IN_A_ROW = 4
"""Clips side by side; more are put into rows."""
SEEN_IN_STATES = ("plots/step/success", "plots/step/intervention", "plots/step/done")
OVERLAID = 3
"""Plots of one number each that are seen at once below clips side by side."""

Part = rrb.View | rrb.Container


def scene_view(
    eye: tuple[float, float, float],
    look_at: tuple[float, float, float] = LOOK_AT,
    origin: str = "world",
    *,
    root: str = "",
    name: str = "scene",
) -> rrb.Spatial3DView:
    """The world below `root`, seen from the point `eye` [m] in the frame of `origin`, which may move."""
    return rrb.Spatial3DView(
        name=name,
        origin=f"{root}{origin}",
        contents=f"{root}world/**",
        background=(245, 245, 245),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eye, look_target=look_at),
    )


def kind_of(clip: Clip) -> str:
    """Which of `FIRST_PLOTS` suits a clip, by what is in it."""
    if "plots/weights" in clip.curves:
        return "correction"
    if "plots/belief" in clip.curves:
        return "interaction"
    if WHO_ACTS in clip.states:
        return "shared_control"
    return "episode" if "plots/action/applied" in clip.curves else "features"


def panels(*, listed: bool = False, plays: bool = True) -> tuple[rrb.TimePanel, rrb.SelectionPanel, rrb.BlueprintPanel]:
    """The viewer's own panels, the one with the list of recordings only where there are several; time runs by itself
    and begins again, or stands at the end.
    """
    return (
        rrb.TimePanel(
            timeline="time",
            state="collapsed",
            play_state="playing" if plays else "following",
            loop_mode="all" if plays else "off",
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="expanded" if listed else "hidden"),
    )


def blueprint_of(clip: Clip, *, listed: bool = False, plays: bool = True) -> rrb.Blueprint:
    """The layout for one clip, which may be `listed` with others."""
    first = [path for path in FIRST_PLOTS[kind_of(clip)] if path in clip.curves]
    others = [path for path in clip.curves if path not in first]
    column: list[Part] = [_plot(clip, path) for path in first]
    if clip.states:
        column.append(rrb.StateTimelineView(name="states", origin="states"))
    rest: list[Part] = [_plot(clip, path) for path in others]
    if clip.about:
        rest.append(rrb.TextDocumentView(name="about", origin="about"))
    if rest:
        column.append(rrb.Tabs(*rest))
    shares = [3.0] * len(first) + [1.2 + 0.8 * len(clip.states)] * bool(clip.states) + [3.0] * bool(rest)
    looks = _looks(clip, "scene")
    if not looks:
        return rrb.Blueprint(rrb.Vertical(*column, row_shares=shares), *panels(listed=listed, plays=plays))
    return rrb.Blueprint(
        rrb.Horizontal(_stacked(looks), rrb.Vertical(*column, row_shares=shares), column_shares=[3, 2]),
        *panels(listed=listed, plays=plays),
    )


def beside_blueprint(clips: Sequence[Clip], roots: Sequence[str], *, plays: bool = True) -> rrb.Blueprint:
    """The layout for clips side by side, each below a root: views above, below what can be compared.

    Plots of one number lie over one another, the others stand in a tab for each clip.
    """
    looks = [
        _stacked(_looks(clip, clip.name, root)) for clip, root in zip(clips, roots, strict=True) if _looks(clip, "")
    ]
    shared = [path for path in clips[0].curves if all(path in clip.curves for clip in clips)]
    single = [p for p in shared if clips[0].curves[p].values.shape[1] == 1 and p not in SEEN_IN_STATES]
    first = [path for path in FIRST_PLOTS[kind_of(clips[0])] if path in shared and path not in single]
    below: list[Part] = []
    if any(clip.states for clip in clips):
        below.append(rrb.StateTimelineView(name="states", origin="/", contents=[f"{root}states/**" for root in roots]))
    below += [_overlay(clips, roots, path) for path in single[:OVERLAID]]
    tabs: list[Part] = [_overlay(clips, roots, path) for path in single[OVERLAID:]]
    for clip, root in zip(clips, roots, strict=True):
        if first:
            plots = rrb.Horizontal(*(_plot(clip, path, root) for path in first), name=clip.name)
            tabs.append(plots)
        if clip.about:
            tabs.append(rrb.TextDocumentView(name=f"about {clip.title}", origin=f"{root}about"))
    if tabs:
        below.append(rrb.Tabs(*tabs))
    parts: list[Part] = [rrb.Grid(*looks, grid_columns=min(IN_A_ROW, len(looks)))] if looks else []
    if below:
        parts.append(rrb.Horizontal(*below, column_shares=[*[1.0] * (len(below) - bool(tabs)), *[2.0] * bool(tabs)]))
    return rrb.Blueprint(rrb.Vertical(*parts, row_shares=[2, 1][: len(parts)]), *panels(plays=plays))


def _looks(clip: Clip, name: str, root: str = "") -> list[list[Part]]:
    """Rows of views: the scene where there is one, and what cameras saw."""
    rows: list[list[Part]] = []
    if clip.model is not None or clip.positions:
        rows.append([_scene(clip, name, root)])
    cameras: list[Part] = [
        rrb.Spatial2DView(name=path.removeprefix("cameras/"), origin=f"{root}{path}")
        for path in (*clip.pictures, *clip.videos)
    ]
    if cameras:
        rows.append(cameras)
    return rows


def _scene(clip: Clip, name: str, root: str) -> rrb.Spatial3DView:
    if _drives(clip):
        return scene_view(BEHIND_CAR, AHEAD_OF_CAR, ROBOT_CAR, root=root, name=name)
    return scene_view(EYE, root=root, name=name)


def _stacked(rows: list[list[Part]]) -> Part:
    parts = [row[0] if len(row) == 1 else rrb.Horizontal(*row) for row in rows]
    return parts[0] if len(parts) == 1 else rrb.Vertical(*parts, row_shares=[3, 2])


def _plot(clip: Clip, path: str, root: str = "") -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(name=_heading(clip, path), origin=f"{root}{path}")


def _overlay(clips: Sequence[Clip], roots: Sequence[str], path: str) -> rrb.TimeSeriesView:
    """One quantity of all clips in one plot."""
    return rrb.TimeSeriesView(name=_heading(clips[0], path), origin="/", contents=[f"{root}{path}" for root in roots])


def _heading(clip: Clip, path: str) -> str:
    unit = clip.curves[path].unit
    return path.removeprefix("plots/") + (f" [{unit}]" if unit else "")


def _drives(clip: Clip) -> bool:
    return (
        clip.model is not None
        and mujoco.mj_name2id(clip.model, mujoco.mjtObj.mjOBJ_BODY, ROBOT_CAR.removeprefix("world/")) >= 0
    )
