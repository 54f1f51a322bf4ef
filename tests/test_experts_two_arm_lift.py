from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfd.core.errors import InputError
from lfd.experts.noise import NoisyPolicy
from lfd.experts.style import ExpertStyle
from lfd.experts.two_arm_lift import BASE_YAW, GRASPS_M, HALF_TURN, TwoArmLiftExpert, _in_base
from lfd.run.wilson import wilson_interval
from tests.expert_trials import Meddled, check_same_action, once, pushed, successes


@pytest.fixture(scope="module")
def world():
    from lfd import make_world

    return make_world("TwoArmLift", "panda", 20)


@pytest.mark.slow
def test_two_arm_lift_succeeds_from_at_least_98_percent_of_200_starts(world) -> None:
    found = successes(world, TwoArmLiftExpert(world.spec), 41, 200)
    assert found >= 196, wilson_interval(found, 200)


@pytest.mark.slow
def test_it_succeeds_with_noise_at_every_speed_and_with_every_grasp(world) -> None:
    expert = TwoArmLiftExpert(world.spec, ExpertStyle(speed=(0.6, 1.0), approach="any"))
    assert successes(world, NoisyPolicy(expert, world.spec.labels["action"], scale=0.1), 43, 40) >= 38


def test_the_expert_recovers_from_pushes(world) -> None:
    """Half a second of random actions of both arms, at any time: hands that let go, and a pot that falls."""
    assert successes(world, Meddled(TwoArmLiftExpert(world.spec), pushed(world, (5, 40))), 42, 20) >= 18


def test_the_expert_follows_a_pot_that_is_moved(world) -> None:
    """Turned and shifted while the hands come down on it."""
    pot = world._model.joint("pot_joint0").qposadr[0]

    def move(rng) -> None:
        qpos = world._data.qpos
        qpos[pot : pot + 2] += rng.uniform(-0.03, 0.03, 2)
        turned = Rotation.from_euler("z", rng.uniform(-0.4, 0.4))
        quat = turned * Rotation.from_quat(qpos[pot + 3 : pot + 7], scalar_first=True)
        qpos[pot + 3 : pot + 7] = quat.as_quat(scalar_first=True)

    assert successes(world, Meddled(TwoArmLiftExpert(world.spec), once(10, move)), 44, 10) >= 9


def test_the_same_observation_gives_the_same_action(world) -> None:
    check_same_action(world, lambda: TwoArmLiftExpert(world.spec), 25)


def test_the_bars_are_where_the_model_has_them(world) -> None:
    for grasp in GRASPS_M:
        for bar, name in ((grasp, "pot_handle0"), (HALF_TURN * grasp, "pot_handle1")):
            side = "+" if bar[0] > 0 else "-"
            geom = world._model.geom(f"{name}_{side}")
            assert (np.abs(bar - geom.pos) <= geom.size).all()


def test_an_action_is_turned_into_the_frame_of_the_arms_base(world) -> None:
    bases = {prefix: world._data.body(f"{prefix}base").xmat.reshape(3, 3) for prefix in ("robot0_", "robot1_")}
    action = np.array([0.1, -0.2, 0.3, -0.4, 0.5, -0.6, 1.0])
    for prefix, base in bases.items():
        turned = _in_base(action, BASE_YAW[prefix])
        np.testing.assert_allclose(turned[:3], base.T @ action[:3], atol=1e-12)
        np.testing.assert_allclose(turned[3:6], base.T @ action[3:6], atol=1e-12)
        assert turned[6] == 1.0


def test_speed_and_grasp_are_drawn_within_the_style(world) -> None:
    expert = TwoArmLiftExpert(world.spec, ExpertStyle(speed=(0.5, 0.5), approach="any"))
    seen, actions = world.reset(np.random.default_rng(3)), set()
    for seed in range(20):
        expert.reset(np.random.default_rng(seed))
        action = expert.act(seen).action
        assert np.abs(np.delete(action, [6, 13])).max() <= 0.5 + 1e-12
        actions.add(action.tobytes())
    assert len(actions) == len(GRASPS_M)


def test_another_controller_is_refused(world) -> None:
    with pytest.raises(InputError, match="the TwoArmLift expert drives OSC_POSE, robot 'panda' has JOINT_POSITION"):
        TwoArmLiftExpert(replace(world.spec, controller="JOINT_POSITION"))
