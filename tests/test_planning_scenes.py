import mujoco
import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning.arm_model import load_arm
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.kinematics import GRIPPER, forward
from lfd.planning.scenes import TABLE_HEIGHT_M, cup_scene, reach
from lfd.worlds.environments import make_environment
from lfd.worlds.robots import load_robot
from lfd.worlds.tasks import load_task


@pytest.mark.parametrize("robot", ["panda", "ur5e", "sawyer", "iiwa", "kinova3", "jaco"])
def test_the_ends_hold_the_cup_upright(robot: str) -> None:
    arm = load_arm(robot)
    scene = cup_scene(arm)
    poses = forward(arm, np.stack([scene.start, scene.goal]))
    np.testing.assert_allclose(poses.points[1, GRIPPER], scene.places.goal, atol=1e-12)
    np.testing.assert_allclose(poses.cup_axis[:, 2], 1.0, atol=1e-6)
    assert np.abs(scene.goal - scene.start).max() < np.pi


def test_out_of_reach_is_said() -> None:
    arm = load_arm("panda")
    with pytest.raises(InputError, match=r"'panda' does not reach .* mm away"):
        reach(arm, np.array([1.5, 0.0, 1.0]), arm.home)


def test_a_plan_that_hugs_the_table_does_not_touch_robosuites(rng: np.random.Generator) -> None:
    environment = make_environment(load_task("Lift"), load_robot("panda"), 20)
    assert environment.table_offset[2] == TABLE_HEIGHT_M
    arm = load_arm("panda")
    planner = ArmPlanner(
        arm, cup_scene(arm), features=("table_distance", "cup_tilt"), waypoints=20, duration_s=4.0, smoothness=0.05
    )
    plan = planner.plan(np.array([-5.0, -1.0]), rng=rng)
    assert plan.clearance < 0.05
    model, names = environment.sim.model._model, environment.robots[0].robot_joints
    data = mujoco.MjData(model)
    data.qpos[:] = environment.sim.data.qpos
    joints = [environment.sim.model.joint_name2id(name) for name in names]
    table = model.body("table").id
    for part in np.linspace(0, 19, 200):
        data.qpos[model.jnt_qposadr[joints]] = [np.interp(part, np.arange(20), joint) for joint in plan.trajectory.T]
        mujoco.mj_forward(model, data)
        touching = {int(body) for pair in data.contact.geom for body in model.geom_bodyid[pair]}
        arms = {int(body) for body in touching if model.body(body).name.startswith(("robot0", "gripper0"))}
        assert not (table in touching and arms), [model.body(body).name for body in arms]
