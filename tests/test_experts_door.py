from dataclasses import replace

import mujoco
import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.door import GRASPS_M, LATCH_M, DoorExpert, _on_handle, _swung
from lfd.experts.noise import NoisyPolicy
from lfd.experts.style import ExpertStyle
from lfd.run.wilson import wilson_interval
from tests.expert_trials import Meddled, check_same_action, once, pushed, successes


@pytest.fixture(scope="module")
def world():
    from lfd import make_world

    return make_world("Door", "panda", 20)


@pytest.mark.slow
def test_door_succeeds_from_at_least_98_percent_of_200_starts(world) -> None:
    found = successes(world, DoorExpert(world.spec), 41, 200)
    assert found >= 196, wilson_interval(found, 200)


@pytest.mark.slow
def test_door_succeeds_with_noise_at_every_speed_and_with_every_grasp(world) -> None:
    expert = DoorExpert(world.spec, ExpertStyle(speed=(0.6, 1.0), approach="any"))
    assert successes(world, NoisyPolicy(expert, world.spec.labels["action"], scale=0.1), 43, 40) >= 38


def test_the_expert_recovers_from_pushes(world) -> None:
    """Half a second of random actions, at any time."""
    assert successes(world, Meddled(DoorExpert(world.spec), pushed(world, (5, 60))), 42, 20) >= 18


def test_the_expert_follows_a_door_that_is_moved(world) -> None:
    frame = world._model.body("Door_main").id

    def move(rng) -> None:
        world._model.body_pos[frame, :2] += rng.uniform(-0.03, 0.03, 2)

    assert successes(world, Meddled(DoorExpert(world.spec), once(14, move)), 44, 10) >= 9


def test_the_expert_opens_a_door_that_stands_ajar(world) -> None:
    """The hand is not at it and the latch has sprung back: it would never have got there."""
    hinge = world._model.joint("Door_hinge").qposadr[0]

    def ajar(rng) -> None:
        world._data.qpos[hinge] = 0.25
        mujoco.mj_forward(world._model, world._data)

    assert successes(world, Meddled(DoorExpert(world.spec), once(1, ajar)), 45, 10) >= 9


def test_the_same_observation_gives_the_same_action(world) -> None:
    check_same_action(world, lambda: DoorExpert(world.spec), 30)


def test_points_of_the_handle_are_where_the_model_has_them(world) -> None:
    """At any angle of latch and hinge, and as it will be when the door has swung further."""
    model, data = world._model, mujoco.MjData(world._model)
    angles = [model.joint(name).qposadr[0] for name in ("Door_hinge", "Door_latch_joint")]

    def at(swung: float, turned: float):
        data.qpos[angles] = swung, turned
        mujoco.mj_kinematics(model, data)
        panel = data.body("Door_door")
        return panel.xpos.copy(), matrix_from_wxyz(panel.xquat), data.site("Door_handle").xpos.copy()

    for swung, turned, further in ((0.0, 0.0, 0.2), (0.1, -1.2, 0.1), (0.2, 0.7, 0.05)):
        centre, door, handle = at(swung, turned)
        np.testing.assert_allclose(centre + door @ _on_handle(turned, 0.125), handle, atol=1e-9)
        after = at(swung + further, turned)[2]
        np.testing.assert_allclose(centre + door @ _swung(_on_handle(turned, 0.125), further), after, atol=1e-9)
    np.testing.assert_allclose(at(0.0, 0.0)[1].T @ (data.body("Door_latch").xpos - at(0.0, 0.0)[0]), LATCH_M, atol=1e-9)


def test_speed_and_grasp_are_drawn_within_the_style(world) -> None:
    expert = DoorExpert(world.spec, ExpertStyle(speed=(0.5, 0.5), approach="any"))
    seen, actions = world.reset(np.random.default_rng(3)), set()
    for seed in range(20):
        expert.reset(np.random.default_rng(seed))
        action = expert.act(seen).action
        assert np.abs(action[:6]).max() <= 0.5
        actions.add(action.tobytes())
    assert len(actions) == len(GRASPS_M)


def test_another_controller_is_refused(world) -> None:
    with pytest.raises(InputError, match="the Door expert drives OSC_POSE, robot 'panda' has JOINT_POSITION"):
        DoorExpert(replace(world.spec, controller="JOINT_POSITION"))
