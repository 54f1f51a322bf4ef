"""What is meant to be seen of a model: robosuite's visual geoms, their meshes and colours."""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

VISUAL_GROUP = 1
"""robosuite's group of the geoms that are meant to be seen."""
HIDDEN = ("wall", "floor")
"""How the names of geoms begin that would stand around a scene."""
LOOKED_AT = 4096
"""About how many pixels of a texture its mean is taken of: an odd stride meets every column."""


@dataclass(frozen=True)
class VisualGeom:
    """A geom of a body."""

    body: int
    name: str
    """The geom's, or its number where it has none."""
    kind: int
    """mujoco.mjtGeom."""
    size: Float[np.ndarray, "3"]
    """MuJoCo's sizes of that kind [m]."""
    position: Float[np.ndarray, "3"]
    """In the frame of the body [m]."""
    wxyz: Float[np.ndarray, "4"]
    rgba: Float[np.ndarray, "4"]
    """Colour in [0, 1]: the material's, times the mean of its texture."""
    mesh: int
    """Number of the mesh; -1 for none."""


def visual_geoms(model: mujoco.MjModel) -> Iterator[VisualGeom]:
    """The geoms of a model that are meant to be seen, without walls and floor."""
    for index in range(model.ngeom):
        geom = model.geom(index)
        if geom.group[0] != VISUAL_GROUP or geom.name.startswith(HIDDEN):
            continue
        rgba = _color(model, index)
        if rgba[3] == 0:
            continue
        yield VisualGeom(
            body=int(geom.bodyid[0]),
            name=geom.name or str(index),
            kind=int(geom.type[0]),
            size=geom.size,
            position=geom.pos,
            wxyz=geom.quat,
            rgba=rgba,
            mesh=int(geom.dataid[0]),
        )


def mesh_of(model: mujoco.MjModel, mesh: int) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices [m] and faces of a mesh."""
    asset = model.mesh(mesh)
    vertices = model.mesh_vert[asset.vertadr[0] : asset.vertadr[0] + asset.vertnum[0]]
    return vertices, model.mesh_face[asset.faceadr[0] : asset.faceadr[0] + asset.facenum[0]]


def _color(model: mujoco.MjModel, index: int) -> Float[np.ndarray, "4"]:
    """Colour of a geom: textures themselves are not shown."""
    material = model.geom(index).matid[0]
    if material < 0:
        return np.array(model.geom(index).rgba, dtype=float)
    color = np.array(model.mat_rgba[material], dtype=float)
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    if texture >= 0:
        size = model.tex_height[texture] * model.tex_width[texture] * model.tex_nchannel[texture]
        start = model.tex_adr[texture]
        pixels = model.tex_data[start : start + size].reshape(-1, model.tex_nchannel[texture])
        color[:3] *= pixels[:: len(pixels) // LOOKED_AT | 1, :3].mean(axis=0) / 255
    return color
