import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfd.core.errors import RecipeError, UnknownName
from lfd.experts.reaching import Hand, funnel, nearest_yaw, pointing_down, towards, yaw_of
from lfd.experts.style import ExpertStyle


def test_following_the_action_ends_in_the_pose() -> None:
    """A hand that does what the action says, with the controller's scale, arrives."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        position, turned = rng.uniform(-0.3, 0.3, 3), Rotation.random(rng=rng)
        goal, aim = rng.uniform(-0.3, 0.3, 3), pointing_down(rng.uniform(-3, 3))
        for _ in range(60):
            action = towards(Hand(position, turned.as_matrix()), goal, aim, 1.0, speed=0.8)
            assert np.abs(action[:6]).max() <= 0.8
            assert action[6] == 1.0
            position = position + 0.05 * 0.4 * action[:3]
            turned = Rotation.from_rotvec(0.5 * action[3:6]) * turned
        np.testing.assert_allclose(position, goal, atol=1e-3)
        np.testing.assert_allclose(turned.as_matrix(), aim, atol=1e-3)


def test_pointing_down_is_a_rotation_with_its_z_axis_down() -> None:
    for yaw in np.linspace(-3, 3, 13):
        rotation = pointing_down(yaw)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(rotation[:, 2], [0, 0, -1])
        assert yaw_of(rotation) == pytest.approx(yaw)


def test_the_nearest_yaw_is_within_half_a_period() -> None:
    for yaw in np.linspace(-6, 6, 49):
        found = nearest_yaw(yaw, 0.3, np.pi)
        assert abs(found - yaw) <= np.pi / 2 + 1e-12
        assert np.sin(found - 0.3) == pytest.approx(0, abs=1e-12)


def test_the_funnel_rises_from_0_to_1() -> None:
    assert [funnel(d, 0.01, 0.03) for d in (0.0, 0.01, 0.02, 0.03, 0.1)] == pytest.approx([0, 0, 0.5, 1, 1])


def test_styles_are_drawn_within_their_bounds_and_bad_ones_refused() -> None:
    style = ExpertStyle(speed=(0.5, 0.9), approach="any")
    rng = np.random.default_rng(0)
    speeds, grasps = [style.draw_speed(rng) for _ in range(200)], [style.draw_grasp(rng, 4) for _ in range(200)]
    assert 0.5 <= min(speeds) < 0.55
    assert 0.85 < max(speeds) <= 0.9
    assert set(grasps) == {0, 1, 2, 3}
    assert ExpertStyle().draw_grasp(rng, 4) is None
    with pytest.raises(RecipeError, match=r"test expert_speed = \[0.9, 0.5\]: expected \[lowest, highest\]"):
        ExpertStyle(speed=(0.9, 0.5)).check("test")
    with pytest.raises(UnknownName, match="unknown expert_approach in test: 'left'; known: any, nearest"):
        ExpertStyle(approach="left").check("test")
