from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfd import make_world
from lfd.core.errors import InputError
from lfd.experts.noise import NoisyPolicy
from lfd.experts.nut_assembly_square import HANDLE_M, NutAssemblySquareExpert, levelling, turned
from lfd.experts.style import ExpertStyle
from lfd.run.wilson import wilson_interval
from lfd.worlds.rollout import episode_rng, rollout
from tests.expert_trials import Meddled, check_same_action, once, pushed, put, successes


@pytest.fixture(scope="module")
def world():
    return make_world("NutAssemblySquare", "panda", 20)


def put_nut(world, position, yaw: float) -> None:
    """Put the nut somewhere, flat."""
    put(world, "SquareNut_joint0", position, [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


@pytest.mark.slow
def test_the_nut_is_put_on_its_peg_from_at_least_95_percent_of_200_starts(world) -> None:
    solved = successes(world, NutAssemblySquareExpert(world.spec), 41, 200)
    assert solved >= 190, wilson_interval(solved, 200)


@pytest.mark.slow
@pytest.mark.parametrize(("at", "least"), [(10, 14), (35, 14), (60, 12)])
def test_it_recovers_from_random_actions(world, at, least) -> None:
    """While it reaches, while it carries, and over the peg, where a push may stretch the arm for good."""
    assert successes(world, Meddled(NutAssemblySquareExpert(world.spec), pushed(world, at)), 42, 15) >= least


@pytest.mark.slow
@pytest.mark.parametrize("at", [15, 30, 55])
def test_it_recovers_from_a_nut_put_elsewhere(world, at) -> None:
    policy = Meddled(NutAssemblySquareExpert(world.spec), once(at, lambda _: put_nut(world, [0.0, -0.05, 0.84], 2.5)))
    assert successes(world, policy, 42, 15) >= 14


@pytest.mark.slow
def test_every_speed_and_grasp_succeeds_under_noise(world) -> None:
    expert = NutAssemblySquareExpert(world.spec, ExpertStyle(speed=(0.6, 1.0), approach="any"))
    assert successes(world, NoisyPolicy(expert, world.spec.labels["action"], scale=0.1), 44, 30, 400) >= 29


@pytest.mark.slow
def test_every_yaw_of_the_nut_is_within_the_wrist_s_reach(world) -> None:
    expert = NutAssemblySquareExpert(world.spec)
    for yaw in np.linspace(-np.pi, np.pi, 17)[1:]:
        policy = Meddled(expert, once(1, lambda _, yaw=yaw: put_nut(world, [-0.11, 0.22, 0.84], yaw)))
        assert rollout(world, policy, [], episode_rng("eval", 45, 0), horizon=300, hold_steps=10).success, yaw


def test_the_same_observation_gives_the_same_action(world) -> None:
    check_same_action(world, lambda: NutAssemblySquareExpert(world.spec), 90)


def test_the_drawn_speed_bounds_the_action(world) -> None:
    expert = NutAssemblySquareExpert(world.spec, ExpertStyle(speed=(0.3, 0.3)))
    expert.reset(np.random.default_rng(0))
    seen = world.reset(np.random.default_rng(1))
    assert np.abs(expert.act(seen).action[:6]).max() == pytest.approx(0.3)


def test_the_handle_and_the_peg_are_where_the_expert_takes_them_to_be(world) -> None:
    seen = world.reset(np.random.default_rng(2))
    np.testing.assert_allclose(seen["peg_pos"], [0.23, 0.1, 0.85])
    nut = Rotation.from_quat(seen["SquareNut_quat"], scalar_first=True).as_matrix()
    site = world._data.site("SquareNut_handle_site").xpos
    handle = seen["SquareNut_pos"] + HANDLE_M * nut[:, 0]
    assert np.linalg.norm(handle - site) < 0.01


def test_levelling_brings_the_nearer_end_of_the_axis_up_or_down_by_the_smallest_turn(rng) -> None:
    for _ in range(100):
        frame = Rotation.random(rng=rng).as_matrix()
        rotation = levelling(frame)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(np.abs((rotation @ frame)[:, 2]), [0, 0, 1], atol=1e-12)
        angle = Rotation.from_matrix(rotation).magnitude()
        assert angle == pytest.approx(np.arccos(abs(frame[2, 2])))


def test_turned_is_the_rotation_about_the_vertical() -> None:
    for angle in np.linspace(-3, 3, 7):
        np.testing.assert_allclose(turned(angle), Rotation.from_rotvec([0, 0, angle]).as_matrix(), atol=1e-12)


def test_another_controller_is_refused(world) -> None:
    with pytest.raises(InputError, match="the NutAssemblySquare expert drives OSC_POSE, robot 'panda' has JOINT_POS"):
        NutAssemblySquareExpert(replace(world.spec, controller="JOINT_POSITION"))
