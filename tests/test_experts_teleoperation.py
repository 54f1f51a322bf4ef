from dataclasses import replace

import numpy as np
import pytest

from lfd.core.errors import InputError, RecipeError, UnknownName
from lfd.core.recipe import build
from lfd.core.rotations import matrix_from_wxyz
from lfd.experts.device import DeviceState, WithKeyboard
from lfd.experts.keys import Word
from lfd.experts.teleoperation import SPEEDS, VERDICTS, TeleopPolicy, beyond
from lfd.worlds.robots import TeleopConfig, load_robot, load_teleop, robot_names
from lfd.worlds.rollout import rollout

BASE = TeleopConfig(frame="base", position_gain=1.0, rotation_gain=1.0, dead_band=0.0)
AT_REST = DeviceState(translation=np.zeros(3), rotation=np.zeros(3))


class Scripted:
    """A device that says one state after another."""

    name = "scripted"

    def __init__(self, *states: DeviceState):
        self._states = iter(states)

    def read(self) -> DeviceState:
        return next(self._states, AT_REST)


def said(move=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), *words: Word) -> DeviceState:
    return DeviceState(translation=np.array(move, dtype=float), rotation=np.array(turn, dtype=float), words=words)


def acts(spec, config: TeleopConfig, *states: DeviceState, ee_quat=(0.0, 1.0, 0.0, 0.0)):
    policy = TeleopPolicy(Scripted(*states), spec, config)
    policy.reset(np.random.default_rng(0))
    return [policy.act({"ee_quat": np.array(ee_quat)}) for _ in states]


def test_deflections_become_actions_with_gains(lift_world) -> None:
    config = replace(BASE, position_gain=0.5, rotation_gain=0.2)
    (decision,) = acts(lift_world.spec, config, said((1, -0.5, 0), (0, 0, 1)))
    np.testing.assert_allclose(decision.action, [0.5, -0.25, 0, 0, 0, 0.2, -1])
    np.testing.assert_array_equal(decision.action, decision.expert_action)
    assert decision.verdict is None


def test_the_dead_band_is_left_out_and_motion_begins_at_zero() -> None:
    given = np.array([-0.05, 0.1, 0.55])
    np.testing.assert_allclose(beyond(given, 0.1), [0, 0, 0.5])
    np.testing.assert_allclose(beyond(-given, 0.1), [0, 0, -0.5])
    np.testing.assert_allclose(beyond(np.array([1.0, -1.0, 0.10001]), 0.1), [1, -1, 0], atol=1e-4)


def test_frames(lift_world) -> None:
    spec, push = lift_world.spec, said((1, 0.5, 0.25), (0.1, 0.2, 0.3))
    (faced,) = acts(spec, replace(BASE, frame="view"), push)
    np.testing.assert_allclose(faced.action[:6], [-1, -0.5, 0.25, -0.1, -0.2, 0.3])
    (down,) = acts(spec, replace(BASE, frame="gripper"), push)  # straight down: as in the frame of the base
    np.testing.assert_allclose(down.action[:6], [1, 0.5, 0.25, 0.1, 0.2, 0.3], atol=1e-12)
    quat = np.array([0.1, 0.7, 0.7, -0.1])
    quat /= np.linalg.norm(quat)
    (turned,) = acts(spec, replace(BASE, frame="gripper"), said((0, 0, 1)), ee_quat=quat)
    np.testing.assert_allclose(turned.action[:3], -matrix_from_wxyz(quat)[:, 2])  # up is against the fingers


def test_the_gripper_toggles_and_opens_with_each_episode(lift_world) -> None:
    decisions = acts(lift_world.spec, BASE, AT_REST, _word(Word.GRIPPER), AT_REST)
    assert [d.action[-1] for d in decisions] == [-1, 1, 1]
    policy = TeleopPolicy(Scripted(_word(Word.GRIPPER), AT_REST), lift_world.spec, BASE)
    for expected in (1, -1):
        policy.reset(np.random.default_rng(0))
        assert policy.act({"ee_quat": np.array([0.0, 1, 0, 0])}).action[-1] == expected


def _word(*words: Word) -> DeviceState:
    return replace(AT_REST, words=words)


def test_slower_and_faster_have_ends(lift_world) -> None:
    push = replace(said((0.4, 0, 0)), words=(Word.FASTER,) * 20)
    slow = replace(push, words=(Word.SLOWER,) * 20)
    for state, factor in ((push, SPEEDS[-1]), (slow, SPEEDS[0])):
        (decision,) = acts(lift_world.spec, BASE, state)
        assert decision.action[0] == pytest.approx(min(0.4 * factor, 1.0))


@pytest.mark.parametrize("word", VERDICTS)
def test_words_end_the_episode(word, lift_world) -> None:
    (decision,) = acts(lift_world.spec, BASE, _word(Word.START, word, Word.SUCCESS))
    assert decision.verdict is VERDICTS[word]  # the first counts


def test_what_the_device_said_is_on_record(lift_world) -> None:
    (decision,) = acts(
        lift_world.spec, replace(BASE, frame="view", dead_band=0.5), said((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    )
    axes = {"x": 0.1, "y": 0.2, "z": 0.3, "rx": 0.4, "ry": 0.5, "rz": 0.6, "gripper": -1.0}
    assert decision.signals == {"teleop_axes": axes}


def test_a_pushed_device_moves_the_hand_that_way(lift_world) -> None:
    """The real simulation: half a second along each axis, seen from behind the robot, then facing it."""
    for frame, sign in (("base", 1), ("view", -1)):
        config = replace(BASE, frame=frame, position_gain=0.5)
        for axis in range(3):
            start = lift_world.reset(np.random.default_rng(3))["ee_pos"].copy()
            state = lift_world.get_state()
            policy = TeleopPolicy(Scripted(*[said(np.eye(3)[axis])] * 10), lift_world.spec, config)
            rollout(lift_world, policy, [], np.random.default_rng(3), horizon=10, hold_steps=10, start=state)
            moved = lift_world.observe()[lift_world.layout["ee_pos"]] - start
            assert np.abs(moved).argmax() == axis
            assert moved[axis] * (sign if axis < 2 else 1) > 0.03


def test_a_person_ends_an_episode_of_the_closed_loop(lift_world) -> None:
    for word, success in ((Word.SUCCESS, True), (Word.FAILURE, False)):
        policy = TeleopPolicy(Scripted(AT_REST, AT_REST, _word(word)), lift_world.spec, BASE)
        outcome = rollout(lift_world, policy, [], np.random.default_rng(1), horizon=50, hold_steps=10)
        assert (outcome.steps, outcome.success) == (3, success)
        assert policy.word is word


def test_position_only_controllers_take_the_translation(lift_world) -> None:
    labels = {**lift_world.spec.labels, "action": ("x", "y", "z", "gripper")}
    spec = replace(lift_world.spec, controller="OSC_POSITION", labels=labels)
    (decision,) = acts(spec, BASE, said((1, 0, 0), (1, 1, 1)))
    np.testing.assert_array_equal(decision.action, [1, 0, 0, -1])


def test_controllers_and_robots_that_no_device_drives(lift_world) -> None:
    spec = replace(lift_world.spec, controller="JOINT_POSITION")
    with pytest.raises(InputError, match="it drives OSC_POSE or OSC_POSITION, robot 'panda' has JOINT_POSITION"):
        TeleopPolicy(Scripted(), spec, BASE)
    two = {**lift_world.spec.labels, "action": ("right_x", "left_x")}
    with pytest.raises(InputError, match="a device moves one arm; the action of robot 'panda' is right_x, left_x"):
        TeleopPolicy(Scripted(), replace(lift_world.spec, labels=two), BASE)


def test_the_keyboard_says_what_a_device_has_no_buttons_for() -> None:
    keyboard = Scripted(replace(said((0, 1, 0)), words=(Word.REDO,)))
    both = WithKeyboard(Scripted(replace(said((1, 0, 0)), words=(Word.GRIPPER,))), keyboard)
    state = both.read()
    np.testing.assert_array_equal(state.translation, [1, 0, 0])
    assert state.words == (Word.GRIPPER, Word.REDO)
    assert both.name == "scripted"


@pytest.mark.parametrize("name", robot_names())
def test_every_robot_says_how_a_device_moves_it(name) -> None:
    assert load_robot(name).robosuite_name
    assert 0 < load_teleop(name).position_gain <= 1


def test_mistakes_in_the_teleop_table() -> None:
    with pytest.raises(UnknownName, match="unknown frame in panda: 'world'; known: base, gripper, view"):
        build(TeleopConfig, {"frame": "world"}, "panda")
    with pytest.raises(RecipeError, match="panda position_gain = 2.0: must be above 0 and at most 1"):
        build(TeleopConfig, {"position_gain": 2}, "panda")
    with pytest.raises(RecipeError, match="panda dead_band = 1.0: must be at least 0 and below 1"):
        build(TeleopConfig, {"dead_band": 1.0}, "panda")
    with pytest.raises(UnknownName, match="unknown robot 'pand'"):
        load_teleop("pand")
