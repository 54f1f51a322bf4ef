import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import lfd
from lfd.core.channels import channel
from lfd.core.errors import InputError, UnknownName


@pytest.mark.parametrize("name", ["lfd/Lift-Panda-v0", "lfd/TwoArmLift-Baxter-v0", "lfd/Wipe-UR5e-v0"])
def test_a_single_world_is_a_gymnasium_environment(name) -> None:
    env = gymnasium.make(name)
    check_env(env.unwrapped)
    env.close()


def test_every_task_and_robot_is_registered_whichever_is_imported_first() -> None:
    for first, second in (("lfd", "gymnasium"), ("gymnasium", "lfd")):
        code = f"import {first}, {second}; print(sum(n.startswith('lfd/') for n in gymnasium.registry))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert int(done.stdout) == 19 * 7


def test_the_observation_vector_is_laid_out_in_channels() -> None:
    env = lfd.ArmEnv("Door", "panda", control_hz=20, max_seconds=1.0, hold_seconds=0.0)
    vector, _ = env.reset(seed=0)
    seen = env.world.step(np.zeros(7)).observation
    vector = env.world.observe()
    assert sum(place.stop - place.start for place in env.layout.values()) == len(vector)
    for name, place in env.layout.items():
        assert channel(name).unit
        assert len(env.world.spec.labels[name]) == place.stop - place.start
        np.testing.assert_array_equal(vector[place], seen[name])


def test_world_number_i_goes_the_same_way_whatever_n_is(rng) -> None:
    """Through the ends of episodes, with other actions in the other worlds."""
    actions = rng.uniform(-1, 1, (30, 3, 7))
    seen = {}
    for n in (1, 3):
        worlds = lfd.VectorWorld(n, max_seconds=0.5)
        rows = [worlds.reset(seed=5)[0][0]]
        for action in actions:
            observations, rewards, terminated, truncated, _ = worlds.step(action[:n])
            rows.append(np.concatenate([observations[0], [rewards[0], terminated[0], truncated[0]]]))
        seen[n] = np.concatenate(rows)
        worlds.close()
    np.testing.assert_array_equal(seen[1], seen[3])


def test_a_world_whose_episode_is_over_begins_the_next_one_at_once() -> None:
    worlds = lfd.VectorWorld(2, max_seconds=0.25)
    assert worlds.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    first, _ = worlds.reset(seed=0)
    still = np.zeros((2, 7))
    for _ in range(4):
        _, _, _, truncated, infos = worlds.step(still)
        assert not truncated.any()
        assert "final_obs" not in infos
    fresh, _, terminated, truncated, infos = worlds.step(still)
    assert truncated.all()
    assert not terminated.any()
    assert (np.stack(list(infos["final_obs"])) != fresh).any()
    assert (fresh != first).any()
    joint_vel = worlds.layout["joint_vel"]
    assert np.abs(fresh[:, joint_vel]).max() == 0  # at rest: a new episode
    assert np.abs(np.stack(list(infos["final_obs"]))[:, joint_vel]).max() > 0
    worlds.close()


def test_mistakes_say_what_is_expected() -> None:
    with pytest.raises(InputError, match="at least one world, not 0"):
        lfd.VectorWorld(0)
    with pytest.raises(UnknownName, match="unknown task 'Lif'"):
        lfd.VectorWorld(1, "Lif")
    worlds = lfd.VectorWorld(1)
    with pytest.raises(InputError, match="2 seeds for 1 worlds"):
        worlds.reset(seed=[1, 2])
    worlds.reset(seed=0)
    with pytest.raises(InputError, match=r"shape \(2, 7\), 1 worlds take \(1, 7\)"):
        worlds.step(np.zeros((2, 7)))
    with pytest.raises(InputError, match="not finite"):
        worlds.step(np.full((1, 7), np.nan))
    worlds.close()
