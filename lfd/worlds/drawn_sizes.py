"""Sizes that robosuite draws while it loads a model, drawn into the model that is there.

A reset that rebuilds the model costs tens of times as much as one that does not; what changes in between are
the half-sizes of a few boxes. They are set in mjModel to what the compiler would have computed, bit for bit.
"""

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

BOXES: dict[str, dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]]] = {
    "Lift": {"cube": ((0.020, 0.020, 0.020), (0.022, 0.022, 0.022))},
}
"""Task to the boxes that robosuite draws while loading, and the range of their half-sizes [m]."""


def draw_sizes(task: str, env: Any) -> None:
    """Draw the sizes of a task's boxes from numpy's global generator, as loading the model does."""
    for name, (low, high) in BOXES.get(task, {}).items():
        size = np.array([np.random.uniform(least, most) for least, most in zip(low, high, strict=True)])
        resize_box(env, name, size)


def resize_box(env: Any, name: str, size: Float[np.ndarray, "3"]) -> None:
    """Give the box `name` the half-size `size` [m]: in the compiled model, in the XML, and where robosuite reads it."""
    box, model = getattr(env, name), env.sim.model._model
    box.size = size
    geoms = {f"{name}_g0", f"{name}_g0_vis"}
    for element in env.model.root.iter("geom"):
        if element.get("name") in geoms:
            element.set("size", " ".join(str(float(s)) for s in size))
    body = model.body(box.root_body).id
    for geom in (model.geom(g).id for g in geoms):
        model.geom_size[geom] = size
        model.geom_rbound[geom] = np.sqrt(size @ size)
        model.geom_aabb[geom, 3:] = size
    nodes = slice(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
    model.bvh_aabb[nodes, 3:] = size
    x, y, z = size
    mass = box.density * (8 * x * y * z)
    model.body_mass[body] = mass
    model.body_inertia[body] = [mass * (y * y + z * z) / 3, mass * (x * x + z * z) / 3, mass * (x * x + y * y) / 3]
    mujoco.mj_setConst(model, mujoco.MjData(model))  # masses of subtrees, inverse weights, statistics
