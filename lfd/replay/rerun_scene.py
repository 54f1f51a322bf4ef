"""Clips in Rerun. This module and `rerun_live` are the only ones that import rerun.

Meshes are logged once, without time; what moves are the transforms of their bodies, sent as columns.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lfd.core.errors import OutputError
from lfd.core.rotations import xyzw_from_wxyz
from lfd.planning.signed_distances import Box, Capsule, Floor, Shape
from lfd.replay.clip import Clip

VISUAL_GROUP = 1  # robosuite's group of the geoms that are meant to be seen
SHAPES = mujoco.mjtGeom
HIDDEN = ("wall", "floor")
FIRST_PLOTS = (
    ("plots/weights", "plots/push", "plots/external_torque"),
    ("plots/belief", "plots/belief_entropy", "plots/action/applied"),
    ("plots/action/applied", "plots/joints/position", "plots/gripper/position"),
)
"""What is seen at once, by kind of episode: corrections, interactions, all others. The first that it has counts."""
PATH_COLORS = {"ee": (60, 130, 246), "a": (60, 130, 246), "planned": (22, 163, 74)}
EYE = (1.05, -0.85, 1.45)
"""From where a clip is seen [m]: the robot's front and right."""
LOOK_AT = (-0.15, 0.05, 0.9)
"""Where that eye looks [m]."""
ROBOT_CAR, BEHIND_CAR, AHEAD_OF_CAR = "world/robot_car", (-16.0, -9.0, 10.0), (4.0, 1.5, 0.0)
"""The robot as a car, from where it is followed, and where that eye looks, in its frame [m]."""
OBJECT_COLOR = (234, 88, 12)
PLAN_COLORS = {"planned": (107, 114, 128), "deformed": (234, 88, 12), "new": (22, 163, 74)}
PUSH_COLOR = (220, 38, 38)
M_PER_N = 0.01
"""Length of a force's arrow."""
TICK_S = 1e-6
"""Less than any step: times are rounded to it when they are looked up."""
SHAPE_COLOR = (110, 110, 110, 160)
"""Of what a plan keeps clear of."""


def replay(clip: Clip, *, save: Path | None, overwrite: bool = False, shapes: Sequence[Shape] = ()) -> None:
    """Write a clip, with shapes that its model does not have, to the file `save`, or open the viewer.

    Raises `OutputError` when the file exists or cannot be written, or when there is no screen.
    """
    recording = rr.RecordingStream("lfd", recording_id=clip.title)
    if save is None and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        raise OutputError("no screen to open the viewer on; write a file with --save X.rrd and open it elsewhere")
    if save is not None and save.exists() and not overwrite:
        raise OutputError(f"{save} exists already; choose another --save, or add --overwrite to replace it")
    file = None if save is None else recording.binary_stream()
    if file is None:
        recording.spawn()
    recording.send_recording_name(clip.title)
    recording.send_blueprint(_blueprint(clip))
    if clip.model is not None and clip.qpos is not None:
        log_shapes(recording, clip.model)
        _log_motion(recording, clip.model, clip.qpos, clip.times)
    _log_scene(recording, shapes)
    _log_paths(recording, clip)
    _log_plans(recording, clip)
    _log_arrows(recording, clip)
    _log_curves(recording, clip)
    _log_pictures(recording, clip)
    recording.flush()
    if save is not None and file is not None:
        _write(save, file.read() or b"")


def _write(path: Path, content: bytes) -> None:
    """Write a file that appears under its name when it is whole.

    Rerun's own file sink leaves a half-written file behind when the disk is full.
    """
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        part.replace(path)
    except OSError as error:
        if part.is_file():
            part.unlink()
        raise OutputError(f"cannot write {path}: {error.strerror}; free space or choose another --save") from error


def _blueprint(clip: Clip) -> rrb.Blueprint:
    def view(path: str) -> rrb.TimeSeriesView:
        unit = clip.curves[path].unit
        return rrb.TimeSeriesView(name=path.removeprefix("plots/") + (f" [{unit}]" if unit else ""), origin=path)

    kinds = [[path for path in kind if path in clip.curves] for kind in FIRST_PLOTS]
    first = next((kind for kind, whole in zip(kinds, FIRST_PLOTS, strict=True) if whole[0] in kind), kinds[-1])
    others = [path for path in clip.curves if path not in first]
    scene = scene_view(BEHIND_CAR, AHEAD_OF_CAR, ROBOT_CAR) if _drives(clip) else scene_view(EYE)
    if clip.pictures:
        pictures = [rrb.Spatial2DView(name=path.removeprefix("cameras/"), origin=path) for path in clip.pictures]
        scene = rrb.Vertical(scene, rrb.Horizontal(*pictures), row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(scene, rrb.Vertical(*map(view, first), rrb.Tabs(*map(view, others))), column_shares=[3, 2]),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def _drives(clip: Clip) -> bool:
    return (
        clip.model is not None
        and mujoco.mj_name2id(clip.model, mujoco.mjtObj.mjOBJ_BODY, ROBOT_CAR.removeprefix("world/")) >= 0
    )


def scene_view(
    eye: tuple[float, float, float], look_at: tuple[float, float, float] = LOOK_AT, origin: str = "world"
) -> rrb.Spatial3DView:
    """The world, seen from the point `eye` [m] in the frame of `origin`, which may move."""
    return rrb.Spatial3DView(
        name="scene",
        origin=origin,
        contents="world/**",
        background=(245, 245, 245),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=eye, look_target=look_at),
    )


def log_shapes(recording: rr.RecordingStream, model: mujoco.MjModel) -> None:
    """Log what is meant to be seen of a model, each shape below its body and without time."""
    for index in range(model.ngeom):
        geom = model.geom(index)
        color = _color(model, index)
        if geom.group[0] != VISUAL_GROUP or color[3] == 0 or geom.name.startswith(HIDDEN):
            continue
        shape = _shape(model, index, color)
        if shape is None:
            continue
        path = f"world/{body_name(model, int(geom.bodyid[0]))}/{geom.name or index}"
        pose = rr.Transform3D(translation=geom.pos, quaternion=rr.Quaternion(xyzw=xyzw_from_wxyz(geom.quat)))
        recording.log(path, pose, shape, static=True)


def _shape(model: mujoco.MjModel, index: int, color: np.ndarray) -> rr.AsComponents | None:
    geom = model.geom(index)
    kind, size = geom.type[0], geom.size
    if kind == SHAPES.mjGEOM_MESH:
        mesh = model.mesh(geom.dataid[0])
        vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        faces = model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
        return rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=faces,
            vertex_normals=vertex_normals(vertices, faces),
            albedo_factor=color,
        )
    solid = rr.components.FillMode.Solid
    if kind == SHAPES.mjGEOM_BOX:
        return rr.Boxes3D(half_sizes=[size], colors=[color], fill_mode=solid)
    if kind in (SHAPES.mjGEOM_SPHERE, SHAPES.mjGEOM_ELLIPSOID):
        radii = size if kind == SHAPES.mjGEOM_ELLIPSOID else np.full(3, size[0])
        return rr.Ellipsoids3D(half_sizes=[radii], colors=[color], fill_mode=solid)
    if kind == SHAPES.mjGEOM_CYLINDER:
        return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], colors=[color], fill_mode=solid)
    if kind == SHAPES.mjGEOM_CAPSULE:
        return rr.Capsules3D(
            lengths=[2 * size[1]], radii=[size[0]], translations=[(0, 0, -size[1])], colors=[color], fill_mode=solid
        )
    return None  # planes and height fields have no edge to draw


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of a mesh's vertices: the mean of the faces around each, weighted by area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros(vertices.shape)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _color(model: mujoco.MjModel, index: int) -> np.ndarray:
    """Colour of a geom, 0 to 255: its material's, times the mean of the texture, which Rerun does not get."""
    material = model.geom(index).matid[0]
    if material < 0:
        return (model.geom(index).rgba * 255).astype(np.uint8)
    color = model.mat_rgba[material].copy()
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    if texture >= 0:
        size = model.tex_height[texture] * model.tex_width[texture] * model.tex_nchannel[texture]
        start = model.tex_adr[texture]
        pixels = model.tex_data[start : start + size].reshape(-1, model.tex_nchannel[texture])
        color[:3] *= pixels[:, :3].mean(axis=0) / 255
    return (color * 255).astype(np.uint8)


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Name of a body's entity below `world`."""
    return model.body(body).name or str(body)


def _log_motion(recording: rr.RecordingStream, model: mujoco.MjModel, qpos: np.ndarray, times: np.ndarray) -> None:
    data = mujoco.MjData(model)
    position = np.empty((len(qpos), model.nbody, 3))
    orientation = np.empty((len(qpos), model.nbody, 4))
    for row, posture in enumerate(qpos):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        position[row], orientation[row] = data.xpos, data.xquat
    for body in range(1, model.nbody):
        moves = np.ptp(position[:, body], axis=0).any() or np.ptp(orientation[:, body], axis=0).any()
        rows = slice(None) if moves else slice(1)
        recording.send_columns(
            f"world/{body_name(model, body)}",
            indexes=_clock(times[rows]),
            columns=rr.Transform3D.columns(
                translation=position[rows, body], quaternion=xyzw_from_wxyz(orientation[rows, body])
            ),
        )


def _log_scene(recording: rr.RecordingStream, shapes: Sequence[Shape]) -> None:
    """Log a scene's shapes without time, but for its floor: the model's table is there."""
    solid = rr.components.FillMode.Solid
    for number, shape in enumerate(shapes):
        path = f"world/scene/{type(shape).__name__.lower()}_{number}"
        match shape:
            case Box(centre, half, yaw):
                turn = rr.RotationAxisAngle(axis=(0, 0, 1), radians=yaw)
                box = rr.Boxes3D(
                    centers=[centre],
                    half_sizes=[half],
                    rotation_axis_angles=[turn],
                    colors=[SHAPE_COLOR],
                    fill_mode=solid,
                )
                recording.log(path, box, static=True)
            case Capsule(start, end, radius):
                assert start[:2] == end[:2], "people stand upright"
                person = rr.Capsules3D(
                    lengths=[end[2] - start[2]],
                    radii=[radius],
                    translations=[start],
                    colors=[SHAPE_COLOR],
                    fill_mode=solid,
                )
                recording.log(path, person, static=True)
            case Floor():
                pass


def _log_paths(recording: rr.RecordingStream, clip: Clip) -> None:
    for name, path in clip.positions.items():
        color = PATH_COLORS.get(name, OBJECT_COLOR)
        recording.log(f"world/paths/{name}", rr.LineStrips3D([path], colors=[color], radii=[0.002]), static=True)
        recording.send_columns(
            f"world/paths/{name}/now", indexes=_clock(clip.times), columns=rr.Points3D.columns(positions=path)
        )
        recording.log(f"world/paths/{name}/now", rr.Points3D.from_fields(radii=[0.006], colors=[color]), static=True)


def _log_plans(recording: rr.RecordingStream, clip: Clip) -> None:
    """Ways by a plan, each as long as it holds."""
    for name, ways in clip.plans.items():
        color = PLAN_COLORS.get(name, OBJECT_COLOR)
        for time_s, way in ways:
            recording.set_time("time", duration=time_s)
            recording.set_time("step", sequence=int(np.searchsorted(clip.times, time_s - TICK_S)))
            recording.log(f"world/plans/{name}", rr.LineStrips3D([way], colors=[color], radii=[0.004]))
    recording.reset_time()


def _log_arrows(recording: rr.RecordingStream, clip: Clip) -> None:
    for name, arrow in clip.arrows.items():
        columns = rr.Arrows3D.columns(origins=arrow.origins, vectors=M_PER_N * arrow.forces)
        recording.send_columns(f"world/arrows/{name}", indexes=_clock(clip.times), columns=columns)
        recording.log(f"world/arrows/{name}", rr.Arrows3D.from_fields(colors=[PUSH_COLOR], radii=[0.008]), static=True)


def _log_curves(recording: rr.RecordingStream, clip: Clip) -> None:
    for path, curve in clip.curves.items():
        recording.log(path, rr.SeriesLines(names=list(curve.names)), static=True)
        clock = _clock(clip.times)
        if curve.times is not None:
            steps = np.searchsorted(clip.times, curve.times - TICK_S)
            clock = [rr.TimeColumn("time", duration=curve.times), rr.TimeColumn("step", sequence=steps)]
        recording.send_columns(path, indexes=clock, columns=rr.Scalars.columns(scalars=curve.values))


def _log_pictures(recording: rr.RecordingStream, clip: Clip) -> None:
    for path, pictures in clip.pictures.items():
        recording.log(path, rr.EncodedImage.from_fields(media_type="image/png"), static=True)
        columns = rr.EncodedImage.columns(blob=[np.frombuffer(data, np.uint8) for data in pictures])
        recording.send_columns(path, indexes=_clock(clip.times), columns=columns)


def _clock(times: np.ndarray) -> list[rr.TimeColumn]:
    return [rr.TimeColumn("time", duration=times), rr.TimeColumn("step", sequence=np.arange(len(times)))]
