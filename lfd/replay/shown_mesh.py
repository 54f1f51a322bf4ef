"""Meshes as they are drawn: vertices that are nearly one are merged, and each gets a normal.

MuJoCo keeps a vertex for each corner of a face. Merged ones take an eighth of the room, and what is left out is finer
than a viewer's pixel: a Rerun file of an arm would otherwise be 6 MB before it says anything.
"""

import hashlib
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Integer, UInt32

from lfd.worlds.cameras import simplify
from lfd.worlds.visual_geoms import mesh_of

CELLS, FINEST_M, COARSEST_M = 64, 0.002, 0.01
"""A mesh's grid has its diagonal's 1/64 for a cell, within 2 and 10 mm."""
COARSE = 500
"""Meshes with fewer faces are drawn as they are."""


@dataclass(frozen=True)
class ShownMesh:
    """A mesh ready to be drawn."""

    vertices: Float[np.ndarray, "V 3"]
    """[m]"""
    faces: UInt32[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "V 3"]
    """Unit normals."""


_made: dict[bytes, ShownMesh] = {}
"""Hash of a mesh to how it is drawn: all episodes of a robot share its meshes."""


def shown_mesh(model: mujoco.MjModel, mesh: int) -> ShownMesh:
    """Mesh number `mesh` of a model; simplified once for each mesh in the life of the process."""
    vertices, faces = mesh_of(model, mesh)
    key = hashlib.blake2b(vertices.tobytes() + faces.tobytes(), digest_size=16).digest()
    if key not in _made:
        if len(faces) >= COARSE:
            cell = np.clip(np.linalg.norm(np.ptp(vertices, axis=0)) / CELLS, FINEST_M, COARSEST_M)
            vertices, faces, _ = simplify(vertices, faces, float(cell))
        points = np.array(vertices, dtype=np.float32)
        _made[key] = ShownMesh(points, np.array(faces, dtype=np.uint32), vertex_normals(points, faces))
    return _made[key]


def forget() -> None:
    """Forget what was made, so that it is made anew: for measurements."""
    _made.clear()


def vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Integer[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Unit normals of a mesh's vertices: the mean of the faces around each, weighted by area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    around = faces.ravel()
    normals = np.stack([np.bincount(around, np.repeat(axis, 3), len(vertices)) for axis in across.T], axis=1)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)
