from dataclasses import replace

import numpy as np
import pytest

from lfd import make_world
from lfd.core.errors import UnknownName
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.grippers import GRIPPERS, gripper_of
from lfd.experts.reaching import CLOSE, OPEN, Hand, above, nearest_yaw, pointing_down, side_yaw, towards

PAD_M = {"panda": 0.004, "sawyer": 0.004}
"""Half the thickness of a pad; 0.001 where it is not said."""


def pads_apart(world, observation) -> float:
    """Distance of the middles of the model's pads along the hand's x axis [m]."""
    (gripper,) = world._env.robots[0].gripper.values()
    hand = Hand.of(observation)
    sides = []
    for side in ("left_fingerpad", "right_fingerpad"):
        centre = np.mean([world._data.geom(name).xpos for name in gripper.important_geoms[side]], axis=0)
        sides.append(hand.rotation[:, 0] @ (centre - hand.position))
    return abs(sides[0] - sides[1])


@pytest.mark.slow
@pytest.mark.parametrize("robot", sorted(GRIPPERS))
def test_what_is_said_of_a_gripper_is_so_in_its_model(robot) -> None:
    """The cube is gripped, or not, while the opening is compared with the distance of the pads in the model."""
    world = make_world("Lift", robot, 20)
    gripper, closing = gripper_of(world.spec), 260 if robot == "jaco" else 40
    for seed, height in ((0, 0.0), (1, 0.0), (2, 0.08)):
        seen = world.reset(np.random.default_rng(seed))
        presses = []
        for step in range(60 + closing):
            hand = Hand.of(seen)
            yaw = nearest_yaw(np.pi / 2, side_yaw(matrix_from_wxyz(seen["cube_quat"])), np.pi / 2)
            target = above(seen["cube_pos"], 0.06 if step < 30 else height)
            action = towards(hand, target, pointing_down(yaw), OPEN if step < 60 else CLOSE)
            seen = world.step(action).observation
            apart = pads_apart(world, seen) - 2 * PAD_M.get(robot, 0.001)
            width = gripper.opening(seen)
            assert width == pytest.approx(apart, abs=0.003)
            if step > 60 and 0.030 < width < (0.066 if gripper.holds_edges else 0.048):
                presses.append(gripper.has_stopped(seen))
        if height:
            assert not any(presses)  # it closes on nothing
        else:
            assert all(presses[-5:])


def test_an_unknown_robot_is_named_with_those_that_are_known(lift_world) -> None:
    with pytest.raises(UnknownName, match="unknown robot of an expert that grasps 'arm'; known: iiwa, jaco"):
        gripper_of(replace(lift_world.spec, robot="arm"))
