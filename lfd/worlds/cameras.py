"""Pictures of a simulated scene, drawn offscreen and made fast on a CPU.

robosuite spends a frame on transforming 170,000 mesh faces, twice because the floor reflects. Here a model of
its own is drawn: its meshes are simplified, geoms outside the picture are left out, and edges are antialiased in
small pictures only. After that the floor's reflections are cheap enough to keep; where much floor is seen,
leaving them out would change a picture by 2/255 in the mean. The kinematic tree is the simulation's, so that its
states place everything. Nothing is simulated with this model.
"""

import atexit
import ctypes.util
import logging
import os
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int, UInt8

from lfd.core.errors import InputError, SimulationError, UnknownName
from lfd.worlds.rendering import BACKENDS, OFF, advice, wished

STATE, EVERYTHING = mujoco.mjtState.mjSTATE_INTEGRATION, mujoco.mjtCatBit.mjCAT_ALL.value
SMALL = 128 * 128
"""Up to here [pixels] edges are antialiased. Above, that would cost Mesa's CPU renderer more than everything else,
and edges are a smaller part of the picture."""
CELLS, FINEST, COARSEST = (45, 80), 0.003, 0.030
"""A mesh's grid has its diagonal's 1/45 for a cell, in large pictures its 1/80, within 3 and 30 mm."""
COLLISION, LEFT_OUT = 0, 5
"""Geom groups that are not drawn: robosuite's for collision geoms, and ours for what the picture does not show."""
CORNERS = np.array(list(product((-1, 1), repeat=3)))
FOLLOWED = (
    *("body_pos", "body_quat", "body_ipos", "body_iquat", "jnt_pos", "jnt_axis", "qpos0", "geom_pos", "geom_quat"),
    *("geom_size", "geom_aabb", "geom_rgba", "geom_matid", "mat_rgba", "cam_pos", "cam_quat", "cam_fovy"),
    *("cam_pos0", "cam_poscom0", "cam_mat0", "light_pos", "light_dir", "light_pos0", "light_poscom0", "light_dir0"),
)
"""The numbers of a model that decide its picture and may change without another compilation."""
logger = logging.getLogger(__name__)


class Cameras:
    """Draws cameras of one model, always with the same picture size.

    Several may live in one process; any thread may use one, but only one at a time.

    Raises `UnknownName` for a camera that the model does not have, `InputError` for a size that is not
    positive, `SimulationError` when this machine cannot draw offscreen.
    """

    def __init__(self, model_xml: str, names: Sequence[str], *, height: int, width: int):
        if height < 1 or width < 1:
            raise InputError(f"a picture of {height} x {width} pixels cannot be drawn; give a height and width of 1 up")
        self._gl = self._context = None
        self._model = model = load_model(model_xml)
        known = [model.camera(i).name for i in range(model.ncam)]
        for name in names:
            if name not in known:
                raise UnknownName("camera", name, known)
        self._ids = {name: model.camera(name).id for name in names}
        self._groups = model.geom_group.copy()
        self._make_cheap(height, width)
        self._data = mujoco.MjData(model)
        self._view = mujoco.MjrRect(0, 0, width, height)
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._option.geomgroup[COLLISION] = 0
        self._option.sitegroup[:] = 0  # robosuite hides them
        self._scene = mujoco.MjvScene(model, maxgeom=10_000)
        self._gl = start_gl(height, width)
        with _current(self._gl):
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)  # uploads meshes and textures
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        atexit.register(_close, weakref.ref(self))  # before EGL itself ends

    def follow(self, model: mujoco.MjModel) -> None:
        """Take the sizes, places and colours of `model`, which must have the same parts, before drawing its states.

        Raises `InputError` when it has other parts, which needs other `Cameras`.
        """
        if model.names != self._model.names or model.ngeom != self._model.ngeom:
            raise InputError("the model has other parts than the one these cameras draw; make new Cameras for it")
        for name in FOLLOWED:
            getattr(self._model, name)[:] = getattr(model, name)

    def render(self, sim_state: Float[np.ndarray, "_"]) -> dict[str, UInt8[np.ndarray, "H W 3"]]:
        """What the cameras see in a state (MuJoCo's mjSTATE_INTEGRATION): RGB, the first row on top.

        Raises `SimulationError` when the state is not one of this model, or after `close`.
        """
        if self._gl is None:
            raise SimulationError("these cameras are closed; make new ones")
        expected = mujoco.mj_stateSize(self._model, STATE)
        if sim_state.shape != (expected,):
            raise SimulationError(f"the state has {sim_state.shape} numbers, the cameras' model has {expected}")
        mujoco.mj_setState(self._model, self._data, np.array(sim_state), STATE)
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight, mujoco.mj_tendon):
            stage(self._model, self._data)
        with _current(self._gl):
            return {name: self._draw(camera) for name, camera in self._ids.items()}

    def close(self) -> None:
        """Free what the graphics library holds."""
        if self._gl is not None:
            with _current(self._gl):
                if self._context is not None:
                    self._context.free()
            self._gl.free()
        self._gl = self._context = None

    def __del__(self) -> None:
        if hasattr(self, "_gl"):
            self.close()

    def _make_cheap(self, height: int, width: int) -> None:
        """Make the model cheap to draw, before the graphics library gets it."""
        model = self._model
        model.vis.global_.offheight, model.vis.global_.offwidth = height, width
        model.vis.quality.offsamples = 4 if height * width <= SMALL else 0
        if not model.light_castshadow.any():
            model.vis.quality.shadowsize = 0  # a shadow map would lie idle
        model.mesh_graphadr[:] = -1  # and so would convex hulls
        # cylinders of 28 slices and 16 rings make a table's legs as dear as the robot; these are off by 1% of a radius
        model.vis.quality.numslices, model.vis.quality.numstacks = 20, 8
        for mesh in range(model.nmesh):
            _simplify_in_place(model, mesh, CELLS[height * width > SMALL])

    def _draw(self, camera: int) -> UInt8[np.ndarray, "H W 3"]:
        self._leave_out(camera)
        eye = mujoco.MjvCamera()
        eye.type, eye.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        mujoco.mjv_updateScene(self._model, self._data, self._option, self._perturb, eye, EVERYTHING, self._scene)
        mujoco.mjr_render(self._view, self._scene, self._context)
        picture = np.empty((self._view.height, self._view.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self._view, self._context)
        return np.ascontiguousarray(picture[::-1])  # OpenGL's first row is at the bottom

    def _leave_out(self, camera: int) -> None:
        """Do not draw geoms whose bounding box lies beside the camera's view, unless their shadow may be in it."""
        model, data = self._model, self._data
        corners = model.geom_aabb[:, None, :3] + CORNERS * (model.geom_aabb[:, None, 3:] + COARSEST / 2)
        places = corners @ data.geom_xmat.reshape(-1, 3, 3).transpose(0, 2, 1) + data.geom_xpos[:, None]
        x, y, z = np.moveaxis((places - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3), 2, 0)
        up = -z * np.tan(np.deg2rad(model.cam_fovy[camera] / 2))  # the camera looks along -z
        side = up * self._view.width / self._view.height
        beside = np.any([(edge > 0).all(1) for edge in (x - side, -x - side, y - up, -y - up)], axis=0)
        drop = beside & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE) & (not model.light_castshadow.any())
        model.geom_group[:] = np.where(drop, LEFT_OUT, self._groups)


def load_model(model_xml: str) -> mujoco.MjModel:
    """The model of a world's state: its mesh and texture paths start with `robosuite/`."""
    package = find_spec("robosuite")
    assert package is not None and package.submodule_search_locations  # noqa: PT018
    folder = Path(next(iter(package.submodule_search_locations))).as_posix()
    return mujoco.MjModel.from_xml_string(model_xml.replace('"robosuite/', f'"{folder}/'))


def start_gl(height: int, width: int) -> Any:
    """An offscreen OpenGL context: EGL, or OSMesa where EGL's library is missing or MUJOCO_GL=osmesa says so.

    Which one must be known before the first is tried, since PyOpenGL is bound to one for the life of a process.
    (robosuite sets MUJOCO_GL=egl by itself, so that value is no wish.) Raises `SimulationError` naming the
    packages to install.
    """
    wish = wished()
    if wish in OFF:
        raise SimulationError(f"MUJOCO_GL={wish} turns rendering off; unset MUJOCO_GL to use cameras")
    loaded = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    allowed = [loaded] if loaded in BACKENDS else ["osmesa"] if wish == "osmesa" else list(BACKENDS)
    found = [name for name in allowed if ctypes.util.find_library(BACKENDS[name][0])]
    if not found:
        raise SimulationError(f"cameras need a library for offscreen rendering, none was found. {advice(allowed)}")
    if found[0] != next(iter(BACKENDS)) and wish != found[0]:
        logger.warning("EGL's library is missing: cameras use OSMesa, which is slower")
    try:
        return import_module(f"mujoco.{found[0]}").GLContext(width, height)
    except Exception as error:  # PyOpenGL raises whatever its library says, down to AttributeError
        other = " Another way may work: MUJOCO_GL=osmesa." if found[0] == "egl" else ""
        reason = str(error).rstrip(".")
        raise SimulationError(
            f"offscreen rendering by {found[0]} does not start: {reason}. {advice(allowed)}{other}"
        ) from error


@contextmanager
def _current(gl: Any) -> Iterator[None]:
    """Draw with an OpenGL context in this thread, and leave it free for others."""
    let_go = _let_go_of_egl if "egl" in type(gl).__module__ else _let_go_of_osmesa
    gl.make_current()
    try:
        yield
    finally:
        let_go()


def _let_go_of_egl() -> None:
    from mujoco.egl import EGL, EGL_DISPLAY

    EGL.eglBindAPI(EGL.EGL_OPENGL_API)  # each thread has its own choice, and lets go of the context of that kind
    EGL.eglMakeCurrent(EGL_DISPLAY, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)


def _let_go_of_osmesa() -> None:
    from mujoco.osmesa import GL, osmesa

    osmesa.OSMesaMakeCurrent(None, None, GL.GL_FLOAT, 0, 0)


def simplify(
    points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], cell: float
) -> tuple[Float[np.ndarray, "C 3"], Int[np.ndarray, "K 3"], Int[np.ndarray, "K"]]:
    """Merge all points in a cell of a grid into one, and keep the faces that still have three different ones.

    Returns the merged points, the faces kept, and which of the given ones they are. Clustering is Rossignac and
    Borrel's (1993), the place of a merged point Lindstrom's (2000, eq. 1): the x nearest to the planes of the
    faces around it, min_x sum_f w_f (n_f . (x - p_f))^2 with w_f a face's area. Where these planes leave x
    open (a flat patch), the mean m of the cell's points decides, through 1% of the trace on the diagonal:
    x = m + (A + 0.01 tr(A) I)^-1 b, A = sum w n n^T, b = sum w n n . (p - m). Nothing leaves m by more than
    half a cell along an axis.
    """
    _, cluster = np.unique(_numbered(np.floor(points / cell).astype(np.int64)), return_inverse=True)
    count = cluster.max() + 1
    mean = np.stack([np.bincount(cluster, axis) for axis in points.T], 1) / np.bincount(cluster)[:, None]
    corners = points[faces].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.sqrt(np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20))  # now n sqrt(2 w)
    merged = cluster[faces]
    around, n = merged.ravel(), np.repeat(normal, 3, axis=0)
    gap = (n * (np.repeat(corners[:, 0], 3, axis=0) - mean[around])).sum(1)
    b = np.stack([np.bincount(around, n[:, i] * gap, count) for i in range(3)], 1)
    a = np.stack([np.bincount(around, n[:, i] * n[:, j], count) for i in range(3) for j in range(3)], 1)
    a = a.reshape(-1, 3, 3)
    a += (0.01 * np.trace(a, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    moved = mean + np.clip(np.linalg.solve(a, b[..., None])[..., 0], -cell / 2, cell / 2)
    first = (merged.argmin(1)[:, None] + np.arange(3)) % 3  # the same face may begin at each of its corners
    _, unique = np.unique(_numbered(np.take_along_axis(merged, first, 1)), return_index=True)
    differ = (merged != np.roll(merged, 1, axis=1)).all(1)
    kept = np.sort(unique[differ[unique]])
    return moved, merged[kept], kept


def _numbered(rows: Int[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """One number for each row, equal for equal rows: sorting numbers is ten times as fast as sorting rows."""
    rows = rows - rows.min(0)
    _, y, z = rows.max(0) + 1
    return (rows[:, 0] * y + rows[:, 1]) * z + rows[:, 2]


def _simplify_in_place(model: mujoco.MjModel, mesh: int, cells: int) -> None:
    """Corners keep their normals and texture coordinates, so that shading stays that of the fine mesh."""
    begin, number = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    points = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    cell = np.clip(np.linalg.norm(np.ptp(points, axis=0)) / cells, FINEST, COARSEST)
    moved, faces, kept = simplify(points, model.mesh_face[begin : begin + number], float(cell))
    points[: len(moved)] = moved
    model.mesh_face[begin : begin + len(kept)] = faces
    for corner in (model.mesh_facenormal, model.mesh_facetexcoord):
        corner[begin : begin + len(kept)] = corner[begin + kept]
    model.mesh_facenum[mesh] = len(kept)


def _close(cameras: "weakref.ref[Cameras]") -> None:
    alive = cameras()
    if alive is not None:
        alive.close()
