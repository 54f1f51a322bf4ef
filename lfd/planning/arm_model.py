"""An arm's kinematics, taken from the MuJoCo model that robosuite builds of a robot config."""

from dataclasses import fields
from functools import cache
from itertools import product

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.planning.kinematics import Arm
from lfd.worlds.environments import make_environment
from lfd.worlds.robots import load_model, load_robot
from lfd.worlds.tasks import load_task

SMALL_M = 0.04
"""Half-length up to which a shape is covered by one sphere [m]."""
CUP_RADIUS_M = 0.05
"""Radius of the sphere at the grip site that stands for what is carried [m]."""
CONTROL_HZ = 20
"""A world needs one; kinematics does not depend on it."""


@cache
def load_arm(robot: str, task: str = "Lift") -> Arm:
    """The arm of a robot config as it stands in a task's world; built once in a process.

    Raises `UnknownName` for a robot or task that lfd does not know, and `InputError` for a robot of two arms.
    """
    config, told = load_robot(robot), load_model(robot)
    environment = make_environment(load_task(task), config, CONTROL_HZ)
    if len(environment.robots[0].arms) > 1:
        raise InputError(f"robot {robot!r} has two arms; the planner takes robots with one, such as 'panda'")
    names, site = environment.robots[0].robot_joints, environment.robots[0].eef_site_id["right"]
    return extract(
        robot,
        environment.sim.model._model,
        np.array(environment.sim.data.qpos),
        joints=[environment.sim.model.joint_name2id(name) for name in names],
        grip_site=site,
        limits=(np.array(told.low_rad), np.array(told.high_rad)),
        home=np.array(told.home_rad),
        torque_n_m=np.array(told.torque_n_m),
    )


def extract(
    robot: str,
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, "nq"],
    *,
    joints: list[int],
    grip_site: int,
    limits: tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D"]],
    home: Float[np.ndarray, "D"],
    torque_n_m: Float[np.ndarray, "D"],
) -> Arm:
    """The chain of some joints of a MuJoCo model, with all other joints (fingers) held as in `qpos`."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    addresses = model.jnt_qposadr[joints]
    assert not model.qpos0[addresses].any(), "a joint's angle is measured from 0"
    data.qpos[addresses] = 0.0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    bodies = model.jnt_bodyid[joints]
    origin, rotation = data.xanchor[joints], data.xmat[bodies].reshape(-1, 3, 3)
    carrier = _carriers(model, bodies)
    before = np.concatenate([np.eye(3)[None], rotation[:-1]])
    way = np.diff(origin, axis=0, prepend=np.zeros((1, 3)))
    mass, centre = _masses(model, data, carrier, origin, rotation)
    last = len(joints) - 1
    elbow = last - 3  # the joint before the three of the wrist
    spheres = _spheres(model, data, carrier, origin, rotation)
    grip = rotation[last].T @ (data.site_xpos[grip_site] - origin[last])
    down = data.site_xmat[grip_site].reshape(3, 3)[:, 2]  # out of the fingers: a cup is held from above
    arm = Arm(
        robot=robot,
        low=limits[0],
        high=limits[1],
        home=home,
        torque_n_m=torque_n_m,
        shift=np.einsum("jki,jk->ji", before, way),
        turn=np.einsum("jki,jkl->jil", before, rotation),
        axis=np.einsum("jki,jk->ji", rotation, data.xaxis[joints]),
        mass_kg=mass,
        centre=centre,
        point=np.array([grip, np.zeros(3), grip, *(centre for _, centre, _ in spheres)]),
        point_joint=np.array([last, elbow, last, *(joint for joint, _, _ in spheres)]),
        radius=np.array([0.0, 0.0, CUP_RADIUS_M, *(radius for _, _, radius in spheres)]),
        cup_axis=-rotation[last].T @ down,
    )
    for field in fields(arm):
        if isinstance(array := getattr(arm, field.name), np.ndarray):
            array.setflags(write=False)
    return arm


def _carriers(model: mujoco.MjModel, bodies: np.ndarray) -> list[int]:
    """For each body of the model the last of the arm's joints that moves it, -1 for none."""
    joint_of = {int(body): joint for joint, body in enumerate(bodies)}
    carrier = [-1] * model.nbody
    for body in range(1, model.nbody):  # parents come first
        carrier[body] = joint_of.get(body, carrier[model.body_parentid[body]])
    return carrier


def _masses(model: mujoco.MjModel, data: mujoco.MjData, carrier: list[int], origin: np.ndarray, rotation: np.ndarray):
    """Mass and its centre in the joint's frame, of the bodies that each joint is the last to move."""
    mass, centre = np.zeros(len(origin)), np.zeros((len(origin), 3))
    for body, joint in enumerate(carrier):
        if joint >= 0:
            mass[joint] += model.body_mass[body]
            centre[joint] += model.body_mass[body] * (rotation[joint].T @ (data.xipos[body] - origin[joint]))
    return mass, centre / np.maximum(mass, 1e-12)[:, None]


def _spheres(
    model: mujoco.MjModel, data: mujoco.MjData, carrier: list[int], origin: np.ndarray, rotation: np.ndarray
) -> list[tuple[int, np.ndarray, float]]:
    """Joint, centre in its frame and radius of spheres along the arm's and the gripper's collision shapes.

    A shape with bounding box a >= b >= c (halves) gets centres at most b apart along its longest axis, from b before
    one end to b before the other (a small one gets one, in its middle), and the smallest radius that covers its
    corners. Spheres stick out where the shape is flat. One that lies within another of the same joint is left out.
    """
    found: list[tuple[int, np.ndarray, float]] = []
    for geom in range(model.ngeom):
        joint = carrier[model.geom_bodyid[geom]]
        if joint < 0 or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        longest, width = int(np.argmax(half)), float(np.sort(half)[1])
        reach = half[longest] - width if half[longest] > SMALL_M else 0.0
        steps = np.linspace(-reach, reach, 1 + int(np.ceil(2 * reach / width)))
        centres = middle + np.outer(steps, np.eye(3)[longest])
        away = np.linalg.norm(_corners(model, geom)[:, None] - centres, axis=2)
        radius = float(away.min(axis=1).max(initial=0.0)) or width
        placed = centres @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        found += [(joint, centre, radius) for centre in (placed - origin[joint]) @ rotation[joint]]
    return [
        (joint, centre, radius)
        for i, (joint, centre, radius) in enumerate(found)
        if not any(
            j != i and joint == other and np.linalg.norm(centre - place) + radius < size
            for j, (other, place, size) in enumerate(found)
        )
    ]


def _corners(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "C 3"]:
    """Corners of a collision shape in its own frame; none where it is round at its ends."""
    match model.geom_type[geom]:
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first = model.mesh_vertadr[mesh]
            return model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
        case mujoco.mjtGeom.mjGEOM_BOX:
            return model.geom_size[geom] * np.array(list(product((-1, 1), repeat=3)))
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            turn, (radius, half) = np.linspace(0.0, 2 * np.pi, 8, endpoint=False), model.geom_size[geom, :2]
            rim = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(8, half)])
            return np.concatenate([rim, rim * [1, 1, -1]])
    return np.empty((0, 3))
