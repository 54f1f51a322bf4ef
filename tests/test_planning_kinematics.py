from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning.arm_model import _corners, load_arm
from lfd.planning.kinematics import ELBOW, GRIPPER, SPHERES, Arm, forward, gravity, pull_back
from lfd.worlds.environments import make_environment
from lfd.worlds.robots import load_robot
from lfd.worlds.tasks import load_task

ROBOTS = ["panda", "ur5e", "sawyer", "iiwa", "kinova3", "jaco"]
EXACT = 1e-12


@dataclass
class Simulated:
    """robosuite's own model of an arm."""

    model: Any
    data: Any
    joints: list[int]
    site: int

    def pose(self, posture: np.ndarray) -> None:
        self.data.qpos[self.model.jnt_qposadr[self.joints]] = posture
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)

    @property
    def columns(self) -> np.ndarray:
        return self.model.jnt_dofadr[self.joints]


@cache
def simulated(robot: str) -> Simulated:
    environment = make_environment(load_task("Lift"), load_robot(robot), 20)
    model = environment.sim.model._model
    data = mujoco.MjData(model)
    data.qpos[:] = environment.sim.data.qpos
    names, site = environment.robots[0].robot_joints, environment.robots[0].eef_site_id["right"]
    return Simulated(model, data, [environment.sim.model.joint_name2id(name) for name in names], site)


def postures(arm: Arm, rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(np.maximum(arm.low, -np.pi), np.minimum(arm.high, np.pi), (count, arm.joints))


@pytest.mark.parametrize("robot", ROBOTS)
def test_points_and_axes_are_mujocos(robot: str, rng: np.random.Generator) -> None:
    arm, world = load_arm(robot), simulated(robot)
    angles = postures(arm, rng, 10)
    poses = forward(arm, angles)
    for row, posture in enumerate(angles):
        world.pose(posture)
        np.testing.assert_allclose(poses.origins[row], world.data.xanchor[world.joints], atol=EXACT)
        np.testing.assert_allclose(poses.axes[row], world.data.xaxis[world.joints], atol=EXACT)
        np.testing.assert_allclose(poses.points[row, GRIPPER], world.data.site_xpos[world.site], atol=EXACT)
        elbow = world.data.xanchor[world.joints[arm.joints - 4]]
        np.testing.assert_allclose(poses.points[row, ELBOW], elbow, atol=EXACT)
        up = -world.data.site_xmat[world.site].reshape(3, 3)[:, 2]
        np.testing.assert_allclose(poses.cup_axis[row], up, atol=EXACT)


@pytest.mark.parametrize("robot", ROBOTS)
def test_gradients_are_those_of_mujocos_jacobians(robot: str, rng: np.random.Generator) -> None:
    arm, world = load_arm(robot), simulated(robot)
    angles = postures(arm, rng, 5)
    poses = forward(arm, angles)
    slopes, cup_slopes = rng.standard_normal(poses.points.shape), rng.standard_normal(poses.cup_axis.shape)
    gradient = pull_back(arm, poses, slopes, cup_slopes)
    bodies = world.model.jnt_bodyid[world.joints]
    for row, posture in enumerate(angles):
        world.pose(posture)
        expected, jacobian, turning = np.zeros(arm.joints), np.zeros((3, world.model.nv)), np.zeros((3, world.model.nv))
        for point, joint, slope in zip(poses.points[row], arm.point_joint, slopes[row], strict=True):
            mujoco.mj_jac(world.model, world.data, jacobian, None, point, bodies[joint])
            expected += slope @ jacobian[:, world.columns]
        mujoco.mj_jacBody(world.model, world.data, None, turning, bodies[-1])
        expected += cup_slopes[row] @ np.cross(turning[:, world.columns].T, poses.cup_axis[row]).T
        np.testing.assert_allclose(gradient[row], expected, atol=20 * EXACT)


@pytest.mark.parametrize("robot", ROBOTS)
def test_gravity_torques_are_mujocos(robot: str, rng: np.random.Generator) -> None:
    arm, world = load_arm(robot), simulated(robot)
    angles = postures(arm, rng, 5)
    torques, _ = gravity(arm, forward(arm, angles))
    for row, posture in enumerate(angles):
        world.pose(posture)
        np.testing.assert_allclose(torques[row], world.data.qfrc_bias[world.columns], atol=1e-10)


def test_slopes_of_gravity_torques_are_their_differences(rng: np.random.Generator) -> None:
    arm, step = load_arm("panda"), 1e-6
    angles = postures(arm, rng, 4)
    _, slopes = gravity(arm, forward(arm, angles))
    for joint in range(arm.joints):
        aside = step * np.eye(arm.joints)[joint]
        more, less = (gravity(arm, forward(arm, angles + sign * aside))[0] for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, :, joint], (more - less) / (2 * step), atol=1e-7)
    np.testing.assert_array_equal(slopes, np.swapaxes(slopes, 1, 2))


@pytest.mark.parametrize("robot", ROBOTS)
def test_spheres_cover_the_arm(robot: str, rng: np.random.Generator) -> None:
    """No corner of a mesh, box or cylinder that the joints move is outside all of the arm's spheres."""
    arm, world = load_arm(robot), simulated(robot)
    angles = postures(arm, rng, 1)
    centres = forward(arm, angles).points[0, SPHERES:]
    world.pose(angles[0])
    model, data = world.model, world.data
    moved: set[int] = set()
    for body in range(1, model.nbody):
        if body in model.jnt_bodyid[world.joints] or model.body_parentid[body] in moved:
            moved.add(body)
    seen = 0
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] in moved and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            placed = _corners(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            away = np.linalg.norm(placed[:, None] - centres, axis=2) - arm.radius[SPHERES:]
            assert away.min(axis=1).max(initial=0.0) < 1e-9, model.geom(geom).name
            seen += len(placed)
    assert seen > 50


def test_an_arm_is_read_only_and_loaded_once() -> None:
    arm = load_arm("panda")
    assert load_arm("panda") is arm
    with pytest.raises(ValueError, match="read-only"):
        arm.point[0] = 0.0


def test_a_robot_of_two_arms_is_refused() -> None:
    with pytest.raises(InputError, match="'baxter' has two arms"):
        load_arm("baxter")
