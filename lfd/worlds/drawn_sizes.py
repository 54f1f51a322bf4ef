"""Sizes that robosuite draws while it loads a model, drawn into the model that is there.

A reset that rebuilds the model costs tens of times as much as one that does not; what changes in between are
a few geometries. robosuite's own object is drawn anew, compiled alone, and what the compiler computed for it is
copied into the whole model, bit for bit what loading the whole model would have given.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import mujoco

BODY = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
GEOM = ("geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb", "geom_friction")
SITE = ("site_pos", "site_size")
WRITTEN = ("size", "pos", "quat", "friction", "density", "mass")
"""Attributes of the XML that a drawing changes."""


def _cube(env: Any) -> tuple[Any, Any]:
    return env.cube, type(env.cube)(name="cube", size_min=[0.020] * 3, size_max=[0.022] * 3)


def _peg(env: Any) -> tuple[Any, Any]:
    (low, high), length = env.peg_radius, env.peg_length
    return env.peg, type(env.peg)(name="peg", size_min=(low, length), size_max=(high, length), joints=None)


def _hammer(hammer: Any) -> tuple[Any, Any]:
    ranges = {name: getattr(hammer, f"{name}_range") for name in ("handle_radius", "handle_length", "handle_density")}
    return hammer, type(hammer)(
        name=hammer.name,
        handle_shape=hammer.handle_shape,
        handle_friction=hammer.handle_friction_range,
        head_density_ratio=hammer.head_density_ratio,
        **ranges,
    )


DRAWN: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "Lift": _cube,
    "TwoArmPegInHole": _peg,
    "TwoArmHandover": lambda env: _hammer(env.hammer),
    "TwoArmTransport": lambda env: _hammer(env.transport.objects["payload"]),
}
"""Task to its object and that object drawn anew from numpy's global generator, as loading the model does."""


def draw_sizes(task: str, env: Any, scratch: mujoco.MjData) -> None:
    """Draw what robosuite draws while loading a task's model, into the model that is loaded.

    `scratch` is an MjData of that model for intermediate results; it takes longer to make than to use.
    """
    if task not in DRAWN:
        return
    present, drawn = DRAWN[task](env)
    element = drawn.get_obj()
    for geom in element.iter("geom"):
        geom.attrib.pop("material", None)  # its texture would be read from disk
    model = env.sim.model._model
    _copy(_compiled_alone(env.model.root, element), model)
    mujoco.mj_setConst(model, scratch)  # masses of subtrees, inverse weights, statistics
    written = {(e.tag, e.get("name")): e for e in element.iter() if e.tag in ("geom", "site")}
    for e in env.model.root.iter():
        source = written.get((e.tag, e.get("name")))
        if source is not None:
            e.attrib.update({key: source.attrib[key] for key in WRITTEN if key in source.attrib})
    vars(present).update(vars(drawn))  # robosuite places objects by their size


def _compiled_alone(root: ET.Element, body: ET.Element) -> Any:
    """The model of one body, compiled with the settings of the whole one."""
    alone = ET.Element("mujoco")
    alone.extend(deepcopy([child for child in root if child.tag in ("compiler", "option", "size")]))
    ET.SubElement(alone, "worldbody").append(deepcopy(body))
    return mujoco.MjModel.from_xml_string(ET.tostring(alone, encoding="unicode"))


def _copy(alone: Any, model: Any) -> None:
    """Copy what depends on the geometry of the bodies of `alone` into the bodies of those names in `model`."""
    kinds = (
        (mujoco.mjtObj.mjOBJ_BODY, alone.nbody, BODY),
        (mujoco.mjtObj.mjOBJ_GEOM, alone.ngeom, GEOM),
        (mujoco.mjtObj.mjOBJ_SITE, alone.nsite, SITE),
    )
    for kind, count, fields in kinds:
        for at in range(count):
            name = mujoco.mj_id2name(alone, kind, at)
            to = mujoco.mj_name2id(model, kind, name) if name and name != "world" else -1
            if to >= 0:
                for field in fields:
                    getattr(model, field)[to] = getattr(alone, field)[at]
    for at in range(1, alone.nbody):
        body = model.body(alone.body(at).name).id
        ours = slice(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
        theirs = slice(alone.body_bvhadr[at], alone.body_bvhadr[at] + alone.body_bvhnum[at])
        model.bvh_aabb[ours] = alone.bvh_aabb[theirs]
        model.bvh_child[ours] = alone.bvh_child[theirs]
        model.bvh_depth[ours] = alone.bvh_depth[theirs]
        nodes = alone.bvh_nodeid[theirs].copy()
        nodes[nodes >= 0] += model.body_geomadr[body] - alone.body_geomadr[at]
        model.bvh_nodeid[ours] = nodes
