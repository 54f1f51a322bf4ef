"""The MuJoCo model that a demonstration was recorded with, beside today's of the same task.

A recorded model names meshes on its author's disk and parts by the names of its robosuite. What of it decides poses
is read from the bodies, joints and plain shapes alone: a skeleton, which needs no files.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from lfd.core.errors import EpisodeError

KEPT = ("compiler", "option", "default", "worldbody")
"""Sections of a model that its skeleton has; contacts, actuators, sensors and pictures move nothing."""
ROBOT = re.compile(r"(robot|gripper|mount|fixed_mount|mobilebase|base)\d|left_eef_target|right_eef_target")
TOLERANCE = 1e-6
"""Differences below are the rounding of the recorded XML, which has six digits."""


@dataclass(frozen=True)
class Skeleton:
    """A model without meshes: where its bodies are, in any configuration."""

    model: Any
    data: Any

    def poses(self, qpos: Float[np.ndarray, "_"]) -> Mapping[str, np.ndarray]:
        """Body and site names to their positions [m] in the world."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        bodies = {self.model.body(at).name: self.data.xpos[at].copy() for at in range(1, self.model.nbody)}
        sites = {self.model.site(at).name: self.data.site_xpos[at].copy() for at in range(self.model.nsite)}
        return bodies | sites


def skeleton(xml: str) -> Skeleton:
    """The skeleton of a model.

    Raises `EpisodeError` for a text that is no model of MuJoCo.
    """
    try:
        root = ET.fromstring(xml)
    except ET.ParseError as error:
        raise EpisodeError(f"its model is no XML ({error})") from error
    for section in list(root):
        if section.tag not in KEPT:
            root.remove(section)
    for parent in list(root.iter()):
        for child in list(parent):
            if (
                child.tag in ("geom", "mesh", "material", "texture") and (child.get("mesh") or child.tag != "geom")
            ) or child.tag in ("camera", "light"):
                parent.remove(child)
        for key in ("material", "mesh", "hfield", "texture"):
            parent.attrib.pop(key, None)
    compiler = root.find("compiler")
    compiler = ET.SubElement(root, "compiler") if compiler is None else compiler
    compiler.set("boundmass", "1e-9")  # bodies that are all mesh have no mass here
    compiler.set("boundinertia", "1e-12")
    try:
        model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise EpisodeError(
            f"MuJoCo {mujoco.__version__} cannot compile its model: {str(error).splitlines()[0]}"
        ) from error
    return Skeleton(model, mujoco.MjData(model))


def portable(xml: str) -> str:
    """A model whose mesh and texture paths start with `robosuite/`, where robosuite keeps them today."""
    here = re.sub(r'file="[^"]*?/robosuite/models/', 'file="robosuite/models/', xml)
    return here.replace("robosuite/models/assets/mounts/", "robosuite/models/assets/bases/")


def is_todays(recorded: Skeleton, today: Skeleton) -> bool:
    """Whether a recorded model has all the joints, in their order, and all the bodies and sites of today's."""
    names = [list(_joints(part.model)) for part in (recorded, today)]
    return names[0] == names[1] and set(today.poses(today.model.qpos0)) <= set(recorded.poses(recorded.model.qpos0))


def todays_name(name: str, known: Mapping[str, Any]) -> str | None:
    """The name that a part of a robosuite 1.0 to 1.4 model has today, if it is among `known`."""
    tries = (
        name,
        re.sub(r"^gripper(\d+)_", r"gripper\1_right_", name),
        re.sub(r"^mount(\d+)_", r"fixed_mount\1_", name),
        re.sub(r"_jnt(\d+)$", r"_joint\1", name),
        f"{name}_main",
        f"{name}_g0",
    )
    return next((candidate for candidate in tries if candidate in known), None)


@dataclass(frozen=True)
class Places:
    """Where today's positions and velocities stand in a recorded state."""

    qpos: Int[np.ndarray, "nq"]
    qvel: Int[np.ndarray, "nv"]

    def todays(self, states: Float[np.ndarray, "T _"]) -> Float[np.ndarray, "T _"]:
        """Recorded rows of time, qpos, qvel in today's order."""
        nq = len(self.qpos)
        return states[:, np.concatenate([[0], 1 + self.qpos, 1 + nq + self.qvel])]


def places(recorded: Skeleton | None, today: Skeleton) -> Places:
    """Which number of a recorded state is which of today's model: joint by joint by name, else in the same order.

    Raises `EpisodeError` when the joints are not the same.
    """
    if recorded is None:
        return Places(np.arange(today.model.nq), np.arange(today.model.nv))
    ours, theirs = _joints(today.model), _joints(recorded.model)
    named = {todays_name(name, ours): joint for name, joint in theirs.items()}
    if set(named) != set(ours):  # other names; the kinds must do
        named = dict(zip(ours, theirs.values(), strict=False))
    if len(ours) != len(theirs) or any(ours[name].type != named[name].type for name in ours):
        raise EpisodeError(
            f"its model has the joints {', '.join(theirs)}; today's robosuite has {', '.join(ours)} for this task"
        )
    qpos = [_span(recorded.model.jnt_qposadr, recorded.model.nq, named[name].id) for name in ours]
    qvel = [_span(recorded.model.jnt_dofadr, recorded.model.nv, named[name].id) for name in ours]
    return Places(np.concatenate(qpos), np.concatenate(qvel))


def difference(
    recorded: Skeleton, today: Skeleton, states: Float[np.ndarray, "T _"], order: Places
) -> tuple[float, float]:
    """Largest distance over all states between the recorded model's poses and today's: of grip sites, of the rest [m].

    Robots have other bodies from version to version; of them only the grip sites are compared.
    """
    hands, others = 0.0, 0.0
    nq = today.model.nq
    for was, now in zip(states[:, 1 : 1 + nq], order.todays(states)[:, 1 : 1 + nq], strict=True):
        there, here = recorded.poses(was), today.poses(now)
        for name, position in there.items():
            match = todays_name(name, here)
            if match is None:
                continue
            away = float(np.abs(position - here[match]).max())
            if match.endswith("grip_site"):
                hands = max(hands, away)
            elif not ROBOT.match(match):
                others = max(others, away)
    return hands, others


def adopt(today_xml: str, recorded: Skeleton) -> tuple[str, tuple[str, ...]]:
    """Today's model with the recorded sizes and fixed places, and what was changed.

    Places of what stands in the world and cannot move: the robot's base, a table, a door. Sizes, places and
    friction of shapes outside the robot that are no meshes; their masses follow from their densities.
    """
    root = ET.fromstring(today_xml)
    today, was = skeleton(today_xml), recorded.model
    mujoco.mj_kinematics(was, recorded.data)
    changed = []
    for body in root.findall("worldbody/body"):
        name = body.get("name", "")
        source = _named(was, "body", name)
        if source is not None and was.body_weldid[source] == 0 and not _is_free(body):
            fixed = {"pos": recorded.data.xpos[source], "quat": recorded.data.xquat[source]}
            at = today.model.body(name)
            changed += _write(body, name, fixed, {"pos": at.pos, "quat": at.quat})
    for tag in ("geom", "site"):
        for element in root.iter(tag):
            name = element.get("name", "")
            source = None if not name or ROBOT.match(name) else _named(was, tag, name)
            if source is None or _named(today.model, tag, name) is None:
                continue
            fields = ("pos", "quat") if tag == "site" else ("pos", "quat", "size", "friction")
            theirs, ours = getattr(was, tag)(source), getattr(today.model, tag)(name)
            if theirs.type == ours.type:
                pairs = ({f: getattr(part, f) for f in fields} for part in (theirs, ours))
                changed += _write(element, name, *pairs)
    return ET.tostring(root, encoding="unicode"), tuple(changed)


def _write(
    element: ET.Element, name: str, wanted: Mapping[str, np.ndarray], present: Mapping[str, np.ndarray]
) -> list[str]:
    """Write those attributes of an element that differ; which they were."""
    changed = []
    for field, values in wanted.items():
        if np.abs(values - present[field]).max() > TOLERANCE:
            if field == "quat":
                for other in ("euler", "axisangle", "xyaxes", "zaxis"):
                    element.attrib.pop(other, None)
            element.set(field, " ".join(repr(float(x)) for x in values))
            changed.append(f"{name} {field}")
    return changed


def _is_free(body: ET.Element) -> bool:
    return body.find("freejoint") is not None or body.find("joint[@type='free']") is not None


def _named(model: Any, kind: str, name: str) -> int | None:
    """Number of the part of a model that is called `name` today."""
    count = {"body": model.nbody, "geom": model.ngeom, "site": model.nsite}[kind]
    known = {name: None}
    parts = (getattr(model, kind)(at) for at in range(count))
    return next((part.id for part in parts if part.name and todays_name(part.name, known) == name), None)


def _joints(model: Any) -> dict[str, Any]:
    return {model.joint(at).name: model.joint(at) for at in range(model.njnt)}


def _span(addresses: np.ndarray, end: int, joint: int) -> np.ndarray:
    """The numbers of a joint in qpos or qvel."""
    return np.arange(addresses[joint], addresses[joint + 1] if joint + 1 < len(addresses) else end)
