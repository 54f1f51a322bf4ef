from dataclasses import replace

import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.experts.noise import NoisyPolicy
from lfd.experts.style import ExpertStyle
from lfd.experts.wipe import YAWS, WipeExpert
from lfd.run.wilson import wilson_interval
from tests.expert_trials import Meddled, check_same_action, once, pushed, successes

HORIZON = 400


@pytest.fixture(scope="module")
def world():
    from lfd import make_world

    return make_world("Wipe", "panda", 20)


@pytest.mark.slow
def test_wipe_succeeds_from_at_least_98_percent_of_200_starts(world) -> None:
    found = successes(world, WipeExpert(world.spec), 41, 200, HORIZON)
    assert found >= 196, wilson_interval(found, 200)


@pytest.mark.slow
def test_it_succeeds_with_noise_at_every_speed_and_with_the_tool_either_way(world) -> None:
    expert = WipeExpert(world.spec, ExpertStyle(speed=(0.6, 1.0), approach="any"))
    assert successes(world, NoisyPolicy(expert, world.spec.labels["action"], scale=0.1), 43, 20, HORIZON) >= 18


@pytest.mark.slow
def test_the_expert_recovers_from_pushes(world) -> None:
    """Half a second of random actions, at any time: the tool is tilted, pushed into the table and away from it."""
    assert successes(world, Meddled(WipeExpert(world.spec), pushed(world, (5, 60))), 42, 20, HORIZON) >= 18


def test_the_expert_wipes_what_is_spilt_again(world) -> None:
    """Some of the dirt that was wiped is back, away from the tool."""

    def spill(rng) -> None:
        wiped = world._env.wiped_markers
        for marker in wiped[:10]:
            world._model.geom(marker.visual_geoms[0]).rgba[3] = 1.0
        del wiped[:10]

    assert successes(world, Meddled(WipeExpert(world.spec), once(40, spill)), 44, 5, HORIZON) >= 5


def test_the_dirt_that_is_observed_is_the_dirt_that_robosuite_has_left(world) -> None:
    expert = WipeExpert(world.spec)
    expert.reset(np.random.default_rng(0))
    seen = world.reset(np.random.default_rng(2))
    is_clean, step = False, 0
    while not is_clean:
        left = [m for m in world._env.model.mujoco_arena.markers if m not in world._env.wiped_markers]
        places = np.array([world._data.body(m.root_body).xpos for m in left])
        distances = np.linalg.norm(places - seen["ee_pos"], axis=1)
        assert np.linalg.norm(seen["nearest_dirt_point"] - seen["ee_pos"]) == pytest.approx(distances.min())
        np.testing.assert_allclose(seen["mean_dirt_point"], places.mean(axis=0))
        if step == 30:
            assert len(left) < 100
            np.testing.assert_array_equal(
                world.set_state(world.get_state())["mean_dirt_point"], seen["mean_dirt_point"]
            )
        result = world.step(expert.act(seen).action)
        seen, is_clean, step = result.observation, result.success, step + 1
        assert step < 200
    np.testing.assert_array_equal(seen["nearest_dirt_point"], seen["ee_pos"])
    np.testing.assert_array_equal(seen["mean_dirt_point"], seen["ee_pos"])


def test_the_same_observation_gives_the_same_action(world) -> None:
    check_same_action(world, lambda: WipeExpert(world.spec), 25)


def test_a_tool_that_is_tilted_is_lifted(world) -> None:
    expert, seen = WipeExpert(world.spec), dict(world.reset(np.random.default_rng(1)))
    seen["ee_pos"] = seen["nearest_dirt_point"]
    seen["ee_quat"] = np.array([0.0, 1.0, 0.0, 0.0])
    assert expert.act(seen).action[2] < 0
    seen["ee_quat"] = np.array([np.sin(0.2), np.cos(0.2), 0.0, 0.0])
    assert expert.act(seen).action[2] == 1.0


def test_speed_and_turn_are_drawn_within_the_style(world) -> None:
    expert = WipeExpert(world.spec, ExpertStyle(speed=(0.5, 0.5), approach="any"))
    seen, actions = world.reset(np.random.default_rng(3)), set()
    for seed in range(20):
        expert.reset(np.random.default_rng(seed))
        action = expert.act(seen).action
        assert np.abs(action).max() <= 0.5
        actions.add(action.tobytes())
    assert len(actions) == len(YAWS)


def test_another_controller_is_refused(world) -> None:
    with pytest.raises(InputError, match="the Wipe expert drives OSC_POSE, robot 'panda' has JOINT_POSITION"):
        WipeExpert(replace(world.spec, controller="JOINT_POSITION"))
