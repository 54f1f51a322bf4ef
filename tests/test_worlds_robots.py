import numpy as np
import pytest

from lfd.core.errors import RecipeError
from lfd.core.recipe import build
from lfd.worlds.environments import import_robosuite
from lfd.worlds.robots import RobotModel, load_model, load_robot, robot_names


@pytest.mark.parametrize("name", robot_names())
def test_the_model_table_says_what_robosuites_model_has(name: str) -> None:
    import_robosuite()
    import mujoco
    from robosuite.models.robots.robot_model import create_robot

    told, robot = load_model(name), create_robot(load_robot(name).robosuite_name)
    model = mujoco.MjModel.from_xml_string(robot.get_xml())
    assert set(robot.default_gripper.values()) == {told.gripper}
    np.testing.assert_array_equal(told.home_rad, robot.init_qpos)
    joints = [model.joint(joint) for joint in robot.joints]
    low = [joint.range[0] if joint.limited[0] else -np.inf for joint in joints]
    high = [joint.range[1] if joint.limited[0] else np.inf for joint in joints]
    np.testing.assert_allclose(told.low_rad, low)
    np.testing.assert_allclose(told.high_rad, high)
    np.testing.assert_allclose(told.torque_n_m, [model.actuator(a).ctrlrange[1] for a in robot.actuators])
    cameras = [model.camera(i).name for i in range(model.ncam)]
    assert [camera for camera in told.cameras if not camera.endswith("eye_in_hand")] == cameras[:1]


def test_a_model_table_with_another_number_of_joints_is_refused() -> None:
    table = {"gripper": "x", "cameras": [], "home_rad": [0.0], "low_rad": [0.0], "high_rad": [1.0], "torque_n_m": []}
    with pytest.raises(RecipeError, match="test: each joint needs a number in all of"):
        build(RobotModel, table, "test")
