import json
import resource
from pathlib import Path

import numpy as np
import pytest

from lfd.convert.features import ConvertRecipe, frames_of_episode
from lfd.convert.hdf5.demo_file import read_demo, read_file
from lfd.convert.hdf5.replay import replay_demo
from lfd.convert.hdf5.robomimic_export import export_episodes, export_frames
from lfd.core.episode import Episode
from lfd.core.errors import DatasetError, OutputError
from lfd.core.rotations import xyzw_from_wxyz
from lfd.record.episode_file import read_episode
from lfd.worlds.environments import make_environment
from lfd.worlds.robots import load_robot
from lfd.worlds.tasks import load_task
from tests.hdf5_files import opened
from tests.test_record_episode_file import record_steps

STATE = ("joint_pos", "gripper_pos", "gripper_vel", "ee_pos", "ee_quat")


@pytest.fixture(scope="module")
def episodes(lift_world, tmp_path_factory: pytest.TempPathFactory) -> list[Episode]:
    """Two recordings of random actions, of different lengths."""
    folder, rng = tmp_path_factory.mktemp("recordings"), np.random.default_rng(4)
    made = []
    for steps in (12, 8):
        path = folder / f"{steps}.mcap"
        record_steps(lift_world, path, rng.uniform(-1, 1, (steps, 7)))
        made.append(read_episode(path))
    return made


@pytest.fixture(scope="module")
def exported(episodes: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "demos.hdf5"
    done = export_episodes(episodes, out, valid_fraction=0.5, seed=0)
    assert (done.episodes, done.frames, done.train) == (2, 20, 1)
    return out


def test_what_is_written_is_read_back_to_the_bit(episodes: list[Episode], exported: Path) -> None:
    file = read_file(exported)  # strict: total and num_samples are right
    assert (file.layout, file.env_name, file.robots, file.control_hz) == ("robomimic", "Lift", ("Panda",), 20)
    assert list(file.lengths.values()) == [12, 8]
    for name, episode in zip(file.demos, episodes, strict=True):
        demo, seen = read_demo(file, name), episode.observations
        assert demo.states is not None
        assert demo.rewards is not None
        assert demo.dones is not None
        assert episode.sim_states is not None
        np.testing.assert_array_equal(demo.actions, episode.actions)
        np.testing.assert_array_equal(demo.rewards, episode.rewards)
        np.testing.assert_array_equal(demo.dones, np.arange(len(episode)) == len(episode) - 1)
        np.testing.assert_array_equal(demo.states, episode.sim_states[:-1, :32])
        assert demo.model_xml == episode.model_xml
        for theirs, ours in {
            "robot0_joint_pos": "joint_pos",
            "robot0_joint_vel": "joint_vel",
            "robot0_joint_effort": "joint_effort",
            "robot0_gripper_qpos": "gripper_pos",
            "robot0_gripper_qvel": "gripper_vel",
            "robot0_eef_pos": "ee_pos",
            "cube_pos": "cube_pos",
        }.items():
            np.testing.assert_array_equal(demo.obs[theirs], seen[ours][:-1], err_msg=theirs)
            with opened(exported) as there:
                np.testing.assert_array_equal(there[f"data/{name}/next_obs/{theirs}"], seen[ours][1:])
        np.testing.assert_array_equal(demo.obs["cube_quat"], xyzw_from_wxyz(seen["cube_quat"][:-1]))


def test_its_states_give_the_recorded_observations_again(episodes: list[Episode], exported: Path) -> None:
    file = read_file(exported)
    for name, episode in zip(file.demos, episodes, strict=True):
        found = replay_demo(file, read_demo(file, name))
        for channel, values in episode.observations.items():
            if not channel.endswith("effort"):  # no state says it
                again = found.episode.observations[channel]
                np.testing.assert_allclose(again[:-1], values[:-1], rtol=0, atol=1e-12, err_msg=channel)
                np.testing.assert_allclose(again[-1], values[-1], rtol=0, atol=1e-6, err_msg=channel)
        np.testing.assert_array_equal(found.episode.rewards, episode.rewards)
        np.testing.assert_array_equal(found.episode.successes, episode.successes)
        assert found.deviation.model == "the recorded one"
        assert found.deviation.one_step_qpos < 1e-6
        assert found.deviation.open_loop_ee_m < 1e-6


def test_robosuite_makes_the_environment_and_sees_the_same(exported: Path) -> None:
    with opened(exported) as there:
        args, demo = json.loads(there["data"].attrs["env_args"]), there["data/demo_1"]
        assert (args["env_name"], args["type"]) == ("Lift", 1)
        options = args["env_kwargs"]
        assert options["controller_configs"]["body_parts"]["right"]["type"] == "OSC_POSE"
        env = make_environment(load_task("Lift"), load_robot("panda"), options["control_freq"])
        env.reset_from_xml_string(demo.attrs["model_file"])
        for t in (0, 7, 11):
            env.sim.set_state_from_flattened(demo["states"][t])
            env.sim.forward()
            seen = env._get_observations(force_update=True)
            for name in ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos", "cube_quat"):
                np.testing.assert_array_equal(demo[f"obs/{name}"][t], seen[name], err_msg=name)
            np.testing.assert_array_equal(demo["obs/object"][t], seen["object-state"])


def test_the_masks_split_the_episodes_by_the_seed(episodes: list[Episode], tmp_path: Path) -> None:
    drawn = []
    for seed in range(4):
        out = tmp_path / f"{seed}.hdf5"
        export_episodes(episodes, out, valid_fraction=0.5, seed=seed)
        with opened(out) as there:
            masks = {name: [member.decode() for member in there[f"mask/{name}"][()]] for name in ("train", "valid")}
        assert sorted(masks["train"] + masks["valid"]) == ["demo_1", "demo_2"]
        drawn.append(masks["valid"][0])
    assert set(drawn) == {"demo_1", "demo_2"}
    done = export_episodes(episodes[:1], tmp_path / "one.hdf5", valid_fraction=0.9, seed=0)
    assert done.train == 1  # something is left to train on
    with opened(tmp_path / "one.hdf5") as there:
        assert list(there["mask"]) == ["train"]


def test_rows_of_a_dataset_are_written_under_robosuite_s_names(episodes: list[Episode], tmp_path: Path) -> None:
    recipe = ConvertRecipe(state=STATE, environment_state=("cube_pos", "cube_quat"), action="action")
    frames = [frames_of_episode(episode, recipe, "a.mcap") for episode in episodes]
    done = export_frames(frames, tmp_path / "demos.hdf5", valid_fraction=0.5, seed=0)
    assert (done.episodes, done.frames) == (2, 20)
    file = read_file(tmp_path / "demos.hdf5")
    assert (file.env_name, file.robots) == ("Lift", ("Panda",))
    demo, seen = read_demo(file, "demo_1"), episodes[0].observations
    assert demo.states is None
    np.testing.assert_array_equal(demo.actions, np.float32(episodes[0].actions))
    np.testing.assert_array_equal(demo.obs["robot0_eef_pos"], np.float32(seen["ee_pos"][:-1]))
    quats = seen["ee_quat"][:-1].astype(np.float32)
    np.testing.assert_array_equal(demo.obs["robot0_eef_quat_site"], xyzw_from_wxyz(quats))
    np.testing.assert_array_equal(demo.obs["object"][:, :3], np.float32(seen["cube_pos"][:-1]))
    assert demo.obs["object"].shape == (12, 7)
    with opened(tmp_path / "demos.hdf5") as there:
        after = there["data/demo_1/next_obs/robot0_eef_pos"][()]
    np.testing.assert_array_equal(after[:-1], demo.obs["robot0_eef_pos"][1:])
    np.testing.assert_array_equal(after[-1], demo.obs["robot0_eef_pos"][-1])


def test_episodes_of_different_worlds_are_refused(episodes: list[Episode], tmp_path: Path) -> None:
    from dataclasses import replace

    slow = replace(episodes[1], metadata=replace(episodes[1].metadata, control_hz=10))
    with pytest.raises(DatasetError, match=r"episode 2 is of .*'control_hz': 10.*export them into files of their own"):
        export_episodes([episodes[0], slow], tmp_path / "demos.hdf5", valid_fraction=0.1, seed=0)
    with pytest.raises(DatasetError, match="there is no episode to write"):
        export_episodes([], tmp_path / "demos.hdf5", valid_fraction=0.1, seed=0)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_replaced_only_on_request(episodes: list[Episode], tmp_path: Path) -> None:
    out = tmp_path / "demos.hdf5"
    out.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already; choose another --out, or add --overwrite"):
        export_episodes(episodes, out, valid_fraction=0.1, seed=0)
    assert out.read_bytes() == b"precious"
    export_episodes(episodes[1:], out, valid_fraction=0.1, seed=0, overwrite=True)
    assert read_file(out).lengths == {"demo_1": 8}


@pytest.mark.parametrize("room", [0, 3_000, 100_000])
def test_a_full_disk_leaves_nothing_and_says_so(episodes: list[Episode], tmp_path: Path, capfd, room: int) -> None:
    out = tmp_path / "demos.hdf5"
    was = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, was[1]))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*demos.hdf5: File too large; free space or choose"):
            export_episodes(episodes, out, valid_fraction=0.1, seed=0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, was)
    assert list(tmp_path.iterdir()) == []
    assert "Traceback" not in capfd.readouterr().err
