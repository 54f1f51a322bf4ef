"""What a robosuite world observes: numbers of MjData, read into one flat array.

The array's layout is a list of channels (`lfd.core.channels`), each a run of components with names. Channels
of one kind stand together, so that reading the state is one indexing operation for each of MjData's arrays.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from lfd.core.channels import WXYZ, XYZ
from lfd.worlds.steppers import arms_of
from lfd.worlds.tasks import Task

Labels = Mapping[str, tuple[str, ...]]
DIRT = ("nearest_dirt_point", "mean_dirt_point")


class Sight:
    """Reads the observation of an environment's present model.

    Channels: `joint_pos` [rad], `joint_vel` [rad/s], `joint_effort` [N m] of all arms, one after the other;
    `gripper_pos` [m], `gripper_vel` [m/s], `gripper_effort` [N] of the fingers; `ee_pos` [m] and `ee_quat` (wxyz)
    of the grip site, named `ARM_ee_pos` where there are two arms; `NAME_pos` [m] and `NAME_quat` (wxyz) of each
    object that moves; `NAME_qpos` of an object with joints of its own [rad or m]; `NAME_point` [m]; where there is
    dirt, `nearest_dirt_point` and `mean_dirt_point` [m] of what is left of it. Poses are in the world frame.
    """

    labels: Labels
    """Channel to the names of its components, in the order of the array."""
    slices: Mapping[str, slice]
    """Channel to its place in the array."""
    size: int
    """Length of the array."""
    prefixes: tuple[str, ...]
    """What the names of each arm's channels begin with: nothing for a single arm, else `robot1_` or `left_`."""

    def __init__(self, env: Any, task: Task):
        model, data = env.sim.model._model, env.sim.data._data
        arms, fingers = _joints(env, model)
        own = {o.name: [model.joint(name) for name in o.joints] for o in env.model.mujoco_objects if o.joints}
        jointed = {
            f"{name}_qpos": hinges
            for name, joints in own.items()
            if (hinges := [j for j in joints if j.type[0] != mujoco.mjtJoint.mjJNT_FREE])
        }
        bodies = {o.name: o.root_body for o in env.model.mujoco_objects if o.joints} | dict(task.bodies)
        self.prefixes = tuple(prefix for prefix, _, _ in _named_arms(env))
        hands = {f"{name}ee": robot.gripper[arm].important_sites["grip_site"] for name, robot, arm in _named_arms(env)}
        sites = {f"{n}_pos": s for n, s in hands.items()} | {f"{n}_point": s for n, s in task.points.items()}
        joints = {"joint": arms, "gripper": fingers} if fingers else {"joint": arms}
        parts: list[tuple[np.ndarray, dict[str, tuple[tuple[str, ...], Int[np.ndarray, "_"]]]]] = []
        positions = {f"{kind}_pos": js for kind, js in joints.items()} | jointed
        parts.append(
            (data.qpos, {n: (_names(js), np.array([j.qposadr[0] for j in js])) for n, js in positions.items()})
        )
        for source, suffix in ((data.qvel, "vel"), (data.qfrc_actuator, "effort")):
            found = {f"{n}_{suffix}": (_names(js), np.array([j.dofadr[0] for j in js])) for n, js in joints.items()}
            parts.append((source, found))
        parts.append((data.site_xpos, {n: (XYZ, _rows(model.site(s).id, 3)) for n, s in sites.items()}))
        parts.append((data.xpos, {f"{n}_pos": (XYZ, _rows(model.body(b).id, 3)) for n, b in bodies.items()}))
        parts.append((data.xquat, {f"{n}_quat": (WXYZ, _rows(model.body(b).id, 4)) for n, b in bodies.items()}))
        self.labels, self.slices, reads, at = {}, {}, [], 0
        for source, channels in parts:
            begin = at
            for name, (names, index) in channels.items():
                self.labels[name], self.slices[name] = names, slice(at, at + len(index))
                at += len(index)
            if channels:
                index = np.concatenate([index for _, index in channels.values()])
                reads.append((source.reshape(-1), index, slice(begin, at)))
        for name in hands:
            self.labels[f"{name}_quat"], self.slices[f"{name}_quat"] = WXYZ, slice(at, at + 4)
            at += 4
        markers = getattr(env.model.mujoco_arena, "markers", ())
        for name in DIRT if markers else ():
            self.labels[name], self.slices[name] = XYZ, slice(at, at + 3)
            at += 3
        self.size, self._seen = at, np.empty(at)
        self._reads = [(source, index, self._seen[place]) for source, index, place in reads]
        self._turns = [
            (data.site_xmat[model.site(site).id], self._seen[self.slices[f"{name}_quat"]])
            for name, site in hands.items()
        ]
        self._dirt = _Dirt(model, data, markers, next(iter(hands.values()))) if markers else None

    def read(self) -> Float[np.ndarray, "Do"]:
        """The present observation; the same array at every call."""
        for source, index, target in self._reads:
            source.take(index, out=target, mode="clip")  # any other mode copies once more
        for matrix, target in self._turns:
            mujoco.mju_mat2Quat(target, matrix)
        if self._dirt is not None:
            for name, point in zip(DIRT, self._dirt.left(), strict=True):
                self._seen[self.slices[name]] = point
        return self._seen

    def named(self, vector: Float[np.ndarray, "Do"]) -> dict[str, Float[np.ndarray, "_"]]:
        """An observation vector by channel: views, not copies."""
        return {name: vector[place] for name, place in self.slices.items()}


class _Dirt:
    """The dirt of a table: markers, which robosuite makes transparent when they are wiped."""

    def __init__(self, model: Any, data: Any, markers: Sequence[Any], tool: str):
        self._model, self._data, self._tool = model, data, model.site(tool).id
        self._bodies = np.array([model.body(marker.root_body).id for marker in markers])
        self._geoms = np.array([model.geom(marker.visual_geoms[0]).id for marker in markers])

    def left(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """What is left: the marker nearest to the tool, and the mean of all; the tool itself where none is left [m]."""
        tool = self._data.site_xpos[self._tool]
        places = self._data.xpos[self._bodies[self._model.geom_rgba[self._geoms, 3] > 0]]
        if len(places) == 0:
            return tool, tool
        away = places - tool
        return places[np.argmin(np.einsum("mi,mi->m", away, away))], places.mean(axis=0)


def _named_arms(env: Any) -> list[tuple[str, Any, str]]:
    """Each arm with the prefix of its channels."""
    arms = list(arms_of(env))
    if len(arms) == 1:
        return [("", *arms[0])]
    if len(env.robots) == 1:
        return [(f"{arm}_", robot, arm) for robot, arm in arms]
    return [(f"robot{robot.idn}_", robot, arm) for robot, arm in arms]


def _joints(env: Any, model: Any) -> tuple[list[Any], list[Any]]:
    """The joints of all arms and of all grippers."""
    arms, fingers = [], []
    for robot, arm in arms_of(env):
        part = robot.composite_controller.part_controllers[arm]
        arms += [model.joint(name) for name in part.joint_names]
        fingers += [model.joint(name) for name in robot.gripper[arm].joints]
    return arms, fingers


def _names(joints: list[Any]) -> tuple[str, ...]:
    return tuple(joint.name for joint in joints)


def _rows(row: int, width: int) -> np.ndarray:
    return np.arange(row * width, (row + 1) * width)
