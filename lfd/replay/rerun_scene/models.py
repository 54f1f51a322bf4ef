"""A MuJoCo model in Rerun: its shapes without time, and the transforms of its bodies."""

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun as rr
from jaxtyping import Float

from lfd.core.rotations import xyzw_from_wxyz
from lfd.planning.signed_distances import Box, Capsule, Floor, Shape
from lfd.replay.shown_mesh import shown_mesh
from lfd.worlds.visual_geoms import VisualGeom, visual_geoms

SHAPES = mujoco.mjtGeom
SHAPE_COLOR = (110, 110, 110, 160)
"""Of what a plan keeps clear of."""


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Name of a body's entity below `world`."""
    return model.body(body).name or str(body)


def seen_bodies(model: mujoco.MjModel) -> tuple[int, ...]:
    """The bodies that have something to be seen, but for the world itself."""
    return tuple(sorted({geom.body for geom in visual_geoms(model)} - {0}))


def log_shapes(recording: rr.RecordingStream, model: mujoco.MjModel, root: str = "") -> None:
    """Log what is meant to be seen of a model below `root`, each shape below its body and without time."""
    for geom in visual_geoms(model):
        shape = _shape(model, geom)
        if shape is None:
            continue
        pose = rr.Transform3D(translation=geom.position, quaternion=rr.Quaternion(xyzw=xyzw_from_wxyz(geom.wxyz)))
        recording.log(f"{root}world/{body_name(model, geom.body)}/{geom.name}", pose, shape, static=True)


def _shape(model: mujoco.MjModel, geom: VisualGeom) -> rr.AsComponents | None:
    color, size = (geom.rgba * 255).astype(np.uint8), geom.size
    if geom.kind == SHAPES.mjGEOM_MESH:
        mesh = shown_mesh(model, geom.mesh)
        return rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.faces,
            vertex_normals=mesh.normals,
            albedo_factor=color,
        )
    solid = rr.components.FillMode.Solid
    if geom.kind == SHAPES.mjGEOM_BOX:
        return rr.Boxes3D(half_sizes=[size], colors=[color], fill_mode=solid)
    if geom.kind in (SHAPES.mjGEOM_SPHERE, SHAPES.mjGEOM_ELLIPSOID):
        radii = size if geom.kind == SHAPES.mjGEOM_ELLIPSOID else np.full(3, size[0])
        return rr.Ellipsoids3D(half_sizes=[radii], colors=[color], fill_mode=solid)
    if geom.kind == SHAPES.mjGEOM_CYLINDER:
        return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], colors=[color], fill_mode=solid)
    if geom.kind == SHAPES.mjGEOM_CAPSULE:
        return rr.Capsules3D(
            lengths=[2 * size[1]], radii=[size[0]], translations=[(0, 0, -size[1])], colors=[color], fill_mode=solid
        )
    return None  # planes and height fields have no edge to draw


def log_motion(
    recording: rr.RecordingStream,
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, "N nq"],
    clock: Sequence[rr.TimeColumn],
    root: str = "",
) -> None:
    """Log where the bodies are at each of N times; those that never move without time."""
    data, bodies = mujoco.MjData(model), np.array(seen_bodies(model), dtype=int)
    position = np.empty((len(bodies), len(qpos), 3), dtype=np.float32)
    orientation = np.empty((len(bodies), len(qpos), 4), dtype=np.float32)
    for row, posture in enumerate(qpos):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        position[:, row], orientation[:, row] = data.xpos[bodies], xyzw_from_wxyz(data.xquat[bodies])
    for body, places, turns in zip(bodies, position, orientation, strict=True):
        entity = f"{root}world/{body_name(model, int(body))}"
        if np.ptp(places, axis=0).any() or np.ptp(turns, axis=0).any():
            columns = rr.Transform3D.columns(translation=places, quaternion=turns)
            recording.send_columns(entity, indexes=clock, columns=columns)
        else:
            pose = rr.Transform3D(translation=places[0], quaternion=rr.Quaternion(xyzw=turns[0]))
            recording.log(entity, pose, static=True)


def log_scene(recording: rr.RecordingStream, shapes: Sequence[Shape], root: str = "") -> None:
    """Log a scene's shapes without time, but for its floor: the model's table is there."""
    solid = rr.components.FillMode.Solid
    for number, shape in enumerate(shapes):
        path = f"{root}world/scene/{type(shape).__name__.lower()}_{number}"
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
