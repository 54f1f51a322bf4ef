"""A model in the page's 3-D view, and what is drawn into it: paths, forces, something to drag."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
import viser
from jaxtyping import Float, Int

from lfd.core.rotations import matrix_from_wxyz
from lfd.worlds.cameras import simplify
from lfd.worlds.visual_geoms import VisualGeom, mesh_of, visual_geoms

CELLS, FINEST_M, COARSEST_M = 24, 0.004, 0.015
"""A mesh's grid has its diagonal's 1/24 for a cell, within 4 and 15 mm: some hundred faces for each link of an arm."""
SHAPES = mujoco.mjtGeom
NOWHERE = np.full(7, np.nan)
M_PER_N = 0.01
"""Length of a force's arrow."""
EYE, LOOK_AT = (1.1, -0.7, 1.5), (-0.2, 0.0, 0.95)
"""From where a person looks at first, and where to [m]: nearly opposite to the robot, as in the live view."""
PUSH_COLOR = (220, 38, 38)
PATH_COLORS = {
    "planned": (107, 114, 128), "deformed": (234, 88, 12), "new": (22, 163, 74), "a": (37, 99, 235), "b": (234, 88, 12)
}  # fmt: skip
OTHER_COLOR = (124, 58, 237)


@dataclass(frozen=True)
class _Part:
    """What of a body has one colour, in the frame of the body."""

    body: str
    color: tuple[int, int, int]
    opacity: float
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    @property
    def key(self) -> tuple[object, ...]:
        """Equal for equal parts."""
        return self.body, self.color, self.opacity, self.vertices.tobytes(), self.faces.tobytes()


class ViserScene:
    """Shows a model below a name of viser's scene; see `lfd.replay.live_view.Scene`."""

    def __init__(self, server: viser.ViserServer, root: str = "/world", at: tuple[float, float, float] = (0, 0, 0)):
        """`at` is where the model's world frame stands [m]."""
        self._server, self._root = server, root
        self._frame = server.scene.add_frame(root, show_axes=False, position=at)
        self._parts: dict[tuple[object, ...], viser.MeshHandle] = {}
        self._bodies: dict[str, viser.FrameHandle] = {}
        self._drawn: dict[str, viser.SceneNodeHandle] = {}
        self._dragged: Callable[[viser.SceneNodeDragEvent], None] | None = None
        self._model: mujoco.MjModel | None = None

    def load(self, model: mujoco.MjModel) -> None:
        """Show another model; parts that it shares with the last one stay."""
        parts = {part.key: part for part in parts_of(model)}
        names = {part.body for part in parts.values()}
        with self._server.atomic():
            for key in [key for key in self._parts if key not in parts]:
                self._parts.pop(key).remove()
            for name in [name for name in self._bodies if name not in names]:
                self._bodies.pop(name).remove()
            for name in names - set(self._bodies):
                self._bodies[name] = self._server.scene.add_frame(f"{self._root}/{name}", show_axes=False)
            for number, (key, part) in enumerate(parts.items()):
                if key not in self._parts:
                    self._parts[key] = self._add(part, number)
        self._model, self._shown = model, np.tile(NOWHERE, (model.nbody, 1))

    def move(self, data: mujoco.MjData) -> None:
        """Show the bodies where they are in `data`; those that stayed need no message."""
        assert self._model is not None
        places = np.hstack([data.xpos, data.xquat])
        with self._server.atomic():
            for body in np.flatnonzero((np.abs(places - self._shown) > 1e-6).any(axis=1) | np.isnan(self._shown[:, 0])):
                frame = self._bodies.get(body_name(self._model, int(body)))
                if frame is not None:
                    frame.position, frame.wxyz = places[body, :3], places[body, 3:]
        self._shown = places

    def show(self, visible: bool) -> None:
        """Show or hide all of it."""
        self._frame.visible = visible

    def close(self) -> None:
        """Take everything away."""
        self._frame.remove()

    def on_drag(self, call: Callable[[viser.SceneNodeDragEvent], None] | None) -> None:
        """Have a function called when somebody drags a part of the robot; None: dragging turns the view again."""
        self._dragged = call
        for key, part in self._parts.items():
            self._listen(str(key[0]), part)

    def draw_path(self, name: str, way: Float[np.ndarray, "P 3"]) -> None:
        """Draw a path of the gripper [m], in the place of the last one of that name."""
        segments = np.stack([way[:-1], way[1:]], axis=1)
        color = PATH_COLORS.get(name, OTHER_COLOR)
        self._draw(
            f"path_{name}",
            lambda path: self._server.scene.add_line_segments(path, segments, color, thickness=0.006),
        )

    def draw_force(self, origin: Float[np.ndarray, "3"], force: Float[np.ndarray, "3"]) -> None:
        """Draw a force [N] at a point [m]; none for a force of 0."""
        self.erase("force")
        if force.any():
            arrow = np.stack([origin, origin + M_PER_N * force])[None]
            self._draw(
                "force",
                lambda path: self._server.scene.add_arrows(
                    path, arrow, PUSH_COLOR, shaft_radius=0.008, head_radius=0.02, head_length=0.04
                ),
            )

    def draw_shape(self, name: str, mesh: trimesh.Trimesh, color: tuple[int, int, int]) -> None:
        """Draw something that the model does not have."""
        self._draw(
            f"shape_{name}",
            lambda path: self._server.scene.add_mesh_simple(
                path, np.array(mesh.vertices), np.array(mesh.faces), color=color, opacity=0.5, flat_shading=True
            ),
        )

    def erase(self, *beginnings: str) -> None:
        """Take away what was drawn under names with these beginnings; all without any."""
        for name in [name for name in self._drawn if not beginnings or name.startswith(beginnings)]:
            self._drawn.pop(name).remove()

    def _draw(self, name: str, add: Callable[[str], viser.SceneNodeHandle]) -> None:
        with self._server.atomic():
            self.erase(name)
            self._drawn[name] = add(f"{self._root}/drawn/{name}")

    def _add(self, part: _Part, number: int) -> viser.MeshHandle:
        mesh = self._server.scene.add_mesh_simple(
            f"{self._root}/{part.body}/{number}_{part.color[0]:02x}{part.color[1]:02x}{part.color[2]:02x}",
            part.vertices,
            part.faces,
            color=part.color,
            opacity=None if part.opacity >= 1.0 else part.opacity,
            flat_shading=len(part.faces) < 40,
            side="double",
        )
        self._listen(part.body, mesh)
        return mesh

    def _listen(self, body: str, mesh: viser.MeshHandle) -> None:
        if not body.startswith(("robot", "gripper")):
            return
        mesh.remove_drag_callback()
        if self._dragged is not None:
            call = self._dragged

            async def dragged(event: viser.SceneNodeDragEvent) -> None:  # in their order
                call(event)

            mesh.on_drag(dragged)


def parts_of(model: mujoco.MjModel) -> Sequence[_Part]:
    """What is seen of a model, simplified, one part for each colour of each body."""
    found: dict[tuple[str, tuple[int, int, int], float], list[trimesh.Trimesh]] = {}
    for geom in visual_geoms(model):
        mesh = _mesh(model, geom)
        if mesh is None:
            continue
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = matrix_from_wxyz(geom.wxyz), geom.position
        red, green, blue = (round(255 * float(x)) for x in geom.rgba[:3])
        key = body_name(model, geom.body), (red, green, blue), float(geom.rgba[3])
        found.setdefault(key, []).append(mesh.apply_transform(pose))
    return [_part(key, several) for key, several in found.items()]


def _part(key: tuple[str, tuple[int, int, int], float], meshes: Sequence[trimesh.Trimesh]) -> _Part:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=False)])
    return _Part(*key, vertices, faces.astype(np.uint32))


def _mesh(model: mujoco.MjModel, geom: VisualGeom) -> trimesh.Trimesh | None:
    size = geom.size
    match geom.kind:
        case SHAPES.mjGEOM_MESH:
            vertices, faces = mesh_of(model, geom.mesh)
            cell = np.clip(np.linalg.norm(np.ptp(vertices, axis=0)) / CELLS, FINEST_M, COARSEST_M)
            points, kept, _ = simplify(vertices, faces, float(cell))
            return trimesh.Trimesh(points, kept, process=False)
        case SHAPES.mjGEOM_BOX:
            return trimesh.creation.box(2 * size)
        case SHAPES.mjGEOM_SPHERE:
            return trimesh.creation.icosphere(2, float(size[0]))
        case SHAPES.mjGEOM_ELLIPSOID:
            return trimesh.creation.icosphere(2, 1.0).apply_scale(size)
        case SHAPES.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(float(size[0]), 2 * float(size[1]), sections=20)
        case SHAPES.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(2 * float(size[1]), float(size[0]), count=[12, 12])
            mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
            return mesh
    return None  # planes and height fields have no edge to draw


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Name of a body below the scene's root."""
    return model.body(body).name or f"body_{body}"
