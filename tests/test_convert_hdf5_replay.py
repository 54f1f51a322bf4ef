import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from lfd.convert.hdf5.demo_file import read_demo, read_file
from lfd.convert.hdf5.recorded_model import places, skeleton
from lfd.convert.hdf5.replay import Replayed, replay_demo
from lfd.core.errors import EpisodeError, RecordingError, UnknownName
from lfd.worlds.environments import controller_configs, make_environment, robots_of
from lfd.worlds.robots import load_robot
from lfd.worlds.tasks import load_task
from tests.hdf5_files import DATA, LIFT, REACHING, STACK, opened


def replayed(path: Path, name: str) -> Replayed:
    file = read_file(path)
    return replay_demo(file, read_demo(file, name))


@pytest.fixture(scope="module")
def lift() -> Replayed:
    return replayed(LIFT, "demo_3")


def changed(path: Path, change: Callable[[Any], object], source: Path = LIFT) -> Path:
    """A copy of a file with something changed."""
    shutil.copy(source, path)
    with opened(path, "r+") as there:
        change(there["data"])
    return path


def test_a_person_s_demonstration_becomes_an_episode(lift: Replayed) -> None:
    episode, about = lift.episode, lift.episode.metadata
    assert len(episode) == 392
    assert (about.task, about.robot, about.controller, about.control_hz) == ("Lift", "panda", "OSC_POSE", 20)
    assert (about.policy, about.stage, about.index, about.versions["robosuite"]) == ("human", "record", 1, "1.4.0")
    with opened(LIFT) as there:
        demo = there["data/demo_3"]
        states, actions = demo["states"][()], demo["actions"][()]
    np.testing.assert_array_equal(episode.actions, np.clip(actions, -1, 1))
    np.testing.assert_array_equal(episode.observations["joint_pos"][:-1], states[:, 1:8])
    np.testing.assert_array_equal(episode.observations["cube_pos"][:-1], states[:, 10:13])
    assert episode.sim_states is not None
    np.testing.assert_array_equal(episode.sim_states[:-1, 1:32], states[:, 1:])
    np.testing.assert_allclose(np.diff(episode.sim_states[:, 0]), 1 / 20, atol=1e-9)  # the last row follows, too
    assert episode.success
    assert episode.observations["cube_pos"][-1, 2] > 0.84
    assert not episode.successes[0]


def test_how_far_the_simulator_here_is_from_the_one_that_recorded(lift: Replayed) -> None:
    deviation = lift.deviation
    assert deviation.solved_by_states
    assert not deviation.solved_by_actions  # of the three demonstrations of the original file, two are
    assert 0 < deviation.one_step_ee_m < 1e-3
    assert 0 < deviation.one_step_qpos < 1e-2
    assert 0 < deviation.open_loop_ee_m < 1e-2
    assert deviation.clipped == 34
    assert deviation.controller == ""
    assert replayed(LIFT, "demo_2").deviation.solved_by_actions


def test_sizes_of_the_recorded_model_are_taken_over(lift: Replayed) -> None:
    assert lift.deviation.model == "today's; of the recorded one: cube_g0 size, cube_g0_vis size"
    with opened(LIFT) as there:
        recorded = skeleton(there["data/demo_3"].attrs["model_file"]).model
    used = skeleton(lift.episode.model_xml).model
    np.testing.assert_array_equal(used.geom("cube_g0").size, recorded.geom("cube_g0").size)
    assert used.body("cube_main").mass == pytest.approx(recorded.body("cube_main").mass)
    assert lift.deviation.model_ee_m is not None
    assert lift.deviation.model_ee_m < 1e-12
    assert lift.deviation.model_objects_m == 0


def test_the_recorded_model_says_the_same_of_the_hand_in_plain_mujoco(lift: Replayed) -> None:
    with opened(LIFT) as there:
        demo = there["data/demo_3"]
        xml, states = demo.attrs["model_file"], demo["states"][()]
    recorded = skeleton(xml)
    for t in (0, 100, 391):
        poses = recorded.poses(states[t, 1 : 1 + recorded.model.nq])
        np.testing.assert_allclose(poses["gripper0_grip_site"], lift.episode.observations["ee_pos"][t], atol=1e-12)
        np.testing.assert_allclose(poses["cube_main"], lift.episode.observations["cube_pos"][t], atol=1e-12)


def test_a_model_beside_the_file_corrects_where_the_robot_stands(tmp_path: Path) -> None:
    with_model = replayed(STACK, "demo_1")
    assert with_model.deviation.model == "today's; of the recorded one: robot0_base pos"
    assert (with_model.deviation.model_ee_m, with_model.deviation.model_objects_m) == (0, 0)
    shutil.copy(STACK, tmp_path / STACK.name)
    without = replayed(tmp_path / STACK.name, "demo_1")
    assert without.deviation.model == "today's; the file has none"
    assert without.deviation.model_ee_m is None
    away = with_model.episode.observations["ee_pos"] - without.episode.observations["ee_pos"]
    np.testing.assert_allclose(
        away[:-1], np.tile([0, 0, 0.001], (532, 1)), atol=1e-9
    )  # robosuite 1.0 put it 1 mm higher
    for found in (with_model, without):
        assert found.episode.success
        assert found.deviation.solved_by_actions


def collect(path: Path, task: str, robot: str, rng: np.random.Generator) -> Path:
    """A file as robosuite's own collection writes it."""
    known, config = load_task(task), load_robot(robot)
    env = make_environment(known, config, 20)
    np.random.seed(5)
    env.reset()
    mujoco.mj_saveLastXML(str(path), env.sim.model._model)  # robosuite's get_xml does so, and leaves the file open
    xml, state = path.read_text(), env.sim.get_state().flatten()
    env.reset_from_xml_string(xml)
    env.sim.reset()
    env.sim.set_state_from_flattened(state)
    env.sim.forward()
    states, actions, action = [], [], np.zeros(len(env.action_spec[0]))
    for _ in range(30):
        states.append(env.sim.get_state().flatten())
        action = 0.9 * action + 0.1 * rng.uniform(-1, 1, len(action))
        actions.append(action)
        env.step(action)
    info = {"robots": robots_of(known, config), "controller_configs": controller_configs(config)}
    with opened(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env"], data.attrs["env_info"], data.attrs["repository_version"] = task, json.dumps(info), "1.5.1"
        demo = data.create_group("demo_1")
        demo.attrs["model_file"], demo["states"], demo["actions"] = xml, np.array(states), np.array(actions)
    return path


@pytest.mark.parametrize(("task", "robot"), [("Door", "panda"), ("TwoArmLift", "panda")])
def test_a_file_of_today_s_robosuite_replays_to_rounding(tmp_path: Path, rng, task: str, robot: str) -> None:
    found = replayed(collect(tmp_path / "demos.hdf5", task, robot, rng), "demo_1")
    assert found.deviation.model == "the recorded one"
    assert found.deviation.one_step_qpos < 1e-12
    assert found.deviation.open_loop_ee_m < 1e-12
    assert (found.deviation.model_ee_m, found.deviation.model_objects_m) == (0, 0)


def test_joints_in_another_order_are_found_by_name() -> None:
    xml = (DATA / "model_1.xml").read_text()
    today = skeleton(xml)
    model = today.model
    named = '<joint name="{}" type="free"/>'
    swapped = skeleton(
        "<mujoco><worldbody>"
        + "".join(f'<body name="{name}">{named.format(name)}<geom size="0.1"/></body>' for name in ("b", "a"))
        + "</worldbody></mujoco>"
    )
    straight = skeleton(
        "<mujoco><worldbody>"
        + "".join(f'<body name="{name}">{named.format(name)}<geom size="0.1"/></body>' for name in ("a", "b"))
        + "</worldbody></mujoco>"
    )
    order = places(swapped, straight)
    np.testing.assert_array_equal(order.qpos, [*range(7, 14), *range(7)])
    np.testing.assert_array_equal(order.qvel, [*range(6, 12), *range(6)])
    assert places(None, today).qpos.tolist() == list(range(model.nq))
    with pytest.raises(EpisodeError, match=r"its model has the joints b, a; today's robosuite has robot0_joint1"):
        places(swapped, today)
    assert mujoco.mjtJoint.mjJNT_FREE in model.jnt_type


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        (
            lambda data: data.attrs.modify("env", "Pour"),
            UnknownName,
            "unknown environment in .* 'Pour'; known: Door, Lift",
        ),
        (
            lambda data: data.attrs.modify("env_info", '{"robots": "GR1"}'),
            UnknownName,
            "unknown robot in .* 'GR1'; known: B",
        ),
        (lambda data: data.attrs.modify("env_info", "{}"), RecordingError, "does not name its robot; lfd has Baxter"),
        (
            lambda data: data.attrs.modify(
                "env_info", '{"robots": "Panda", "controller_configs": {"type": "IK_POSE"}}'
            ),
            UnknownName,
            r"unknown controller in .* 'IK_POSE'; known: JOINT_POSITION.*\[map.NAME\]",
        ),
        (
            lambda data: data.attrs.modify(
                "env_info", '{"robots": "Panda", "controller_configs": {"type": "OSC_POSE", "control_delta": false}}'
            ),
            RecordingError,
            "its actions are absolute poses",
        ),
        (
            lambda data: data.attrs.modify(
                "env_info", '{"robots": "Panda", "controller_configs": {"type": "JOINT_POSITION"}}'
            ),
            EpisodeError,
            "demo_3: 'actions' has 7 components, JOINT_POSITION of panda takes 8: robot0_joint1",
        ),
        (
            lambda data: data["demo_3/states"].write_direct(data["demo_3/states"][()] + 0.5, np.s_[40:], np.s_[40:]),
            EpisodeError,
            "demo_3: 'states' row 40 stands 0.5500 s after the one before, 20 Hz puts it 0.0500 s after; --skip-bad",
        ),
        (
            lambda data: data["demo_3"].attrs.modify("model_file", "<mujoco><worldbody>"),
            EpisodeError,
            "demo_3: its model is no XML",
        ),
        (
            lambda data: data.attrs.modify("env", "Stack"),
            EpisodeError,
            "demo_3: its model has the joints robot0_joint1",
        ),
    ],
)
def test_what_cannot_be_replayed_is_said_in_a_sentence(tmp_path: Path, change, kind: type, words: str) -> None:
    path = changed(tmp_path / "demos.hdf5", change)
    with pytest.raises(kind, match=words) as caught:
        replayed(path, "demo_3")
    assert str(path) in str(caught.value)


def test_another_controller_gain_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    shutil.copy(LIFT, path)
    with opened(path, "r+") as there:
        info = json.loads(there["data"].attrs["env_info"])
        info["controller_configs"]["kp"] = 300
        there["data"].attrs["env_info"] = json.dumps(info)
    assert replayed(path, "demo_3").deviation.controller == "kp 300 (here 150)"


def test_a_demonstration_of_an_unknown_world_points_to_its_stored_observations() -> None:
    file = read_file(REACHING, trust_rows=True)
    with pytest.raises(UnknownName, match=r"'ReachingFrankaBC'; known: .*\[map.NAME\] tables of the recipe"):
        replay_demo(file, read_demo(file, "demo_1", trust_rows=True))
