import numpy as np
import pytest

from lfd import make_expert, make_world
from lfd.bench.matrix import compare_cases, quick_matrix, success_rates, whole_matrix
from lfd.core.errors import SimulationError, UnknownName
from lfd.worlds import steppers
from lfd.worlds.robots import CONTROLLERS, robot_names
from lfd.worlds.same_numbers import TOLERANCE, Comparison, compare
from lfd.worlds.steppers import CompiledStepper, make_stepper, uncovered
from lfd.worlds.tasks import TASKS


def numbers(world) -> np.ndarray:
    return np.concatenate([world._data.qpos, world._data.qvel, world._data.ctrl])


def random_actions(world, rng, steps: int) -> list[np.ndarray]:
    """Half of them beyond the limits, to be clipped alike."""
    return list(rng.uniform(-1.5, 1.5, (steps, len(world.spec.action_low))))


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_ten_control_steps_give_robosuites_numbers(controller, rng) -> None:
    """From a reset, whose first substep still uses the controllers' construction, and from mid-episode."""
    world = make_world("Lift", "panda", 20, controller=controller)
    assert world.step_backend == "compiled"
    for seed in range(3):
        world.reset(np.random.default_rng(seed))
        for _ in range(2):
            actions = random_actions(world, rng, 10)
            assert compare(world, actions).ours <= TOLERANCE
            for action in actions:
                world.step(action)


@pytest.mark.slow
def test_every_robot_controller_and_task_gives_robosuites_numbers() -> None:
    """The whole matrix in its quick form: every two of robot, controller and task meet."""
    rows = list(compare_cases(quick_matrix(), control_hz=20, steps=3, seed=0))
    assert [row for row in rows if not row.found.is_same] == []
    assert sum(row.found.ours <= TOLERANCE for row in rows) > 0.9 * len(rows)


@pytest.mark.slow
def test_success_rates_agree_over_100_seeds() -> None:
    rates = success_rates(task="Lift", robot="panda", control_hz=20, episodes=100, seed=3)
    (ours, (our_low, our_high)), (theirs, (their_low, their_high)) = rates["compiled"], rates["robosuite"]
    assert 5 <= theirs <= 95  # else nothing is compared
    assert our_low <= theirs / 100 <= our_high
    assert their_low <= ours / 100 <= their_high


def test_the_quick_matrix_covers_every_pair() -> None:
    quick, whole = quick_matrix(), whole_matrix()
    assert len(whole) == len(TASKS) * len(robot_names()) * len(CONTROLLERS)
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert {(c[first], c[second]) for c in quick} == {(c[first], c[second]) for c in whole}


def test_the_yardstick_is_robosuite_itself() -> None:
    assert Comparison(0, ours=1e-10, itself=0.0).is_same
    assert not Comparison(0, ours=1e-8, itself=0.0).is_same
    assert Comparison(0, ours=1e-3, itself=2e-3).is_same
    assert not Comparison(0, ours=float("nan"), itself=0.0).is_same


def test_sensors_hold_what_they_would_after_robosuites_step(lift_world, rng) -> None:
    lift_world.reset(rng)
    start, action, sensed = lift_world.get_state(), rng.uniform(-1, 1, 7), []
    for name in ("compiled", "robosuite"):
        lift_world.set_state(start)
        make_stepper(name, lift_world._env).step(action)
        sensed.append(lift_world._data.sensordata.copy())
    assert np.abs(sensed[0]).max() > 1
    np.testing.assert_allclose(sensed[0], sensed[1], atol=1e-6)


def test_a_wrong_gain_is_noticed(lift_world, rng, monkeypatch) -> None:
    """The comparison can fail."""
    lift_world.reset(rng)
    init = CompiledStepper.__init__

    def softer(self, env) -> None:
        init(self, env)
        self._arms["kp"] *= 1 + 1e-6

    monkeypatch.setattr(CompiledStepper, "__init__", softer)
    assert not compare(lift_world, random_actions(lift_world, rng, 2)).is_same


def test_a_grasp_gives_robosuites_numbers(lift_world) -> None:
    expert = make_expert(lift_world.spec)
    seen = lift_world.reset(np.random.default_rng(0))
    for _ in range(20):
        seen = lift_world.step(expert.act(seen).action).observation
    assert compare(lift_world, [np.array([0.0, 0, 1, 0, 0, 0, 1])] * 10).is_same


@pytest.mark.parametrize(("task", "robot", "controller"), [
    ("Lift", "panda", "OSC_POSE"), ("Lift", "panda", "JOINT_VELOCITY"), ("TwoArmLift", "iiwa", "OSC_POSE"),
    ("Lift", "jaco", "JOINT_POSITION"), ("Lift", "panda", "JOINT_TORQUE"),
])  # fmt: skip
def test_a_substep_left_to_robosuite_fits_in(task, robot, controller, rng) -> None:
    """What happens at a singular matrix, made to happen in the middle of a step."""
    world = make_world(task, robot, 20, controller=controller)
    world.reset(np.random.default_rng(4))
    for action in random_actions(world, rng, 2):
        world.step(action)
    start, action = world.get_state(), random_actions(world, rng, 1)[0]
    world.step(action)
    whole = numbers(world)
    world.set_state(start)
    stepper = CompiledStepper(world._env)
    args = stepper._physics, stepper._arms, stepper._grippers, stepper._memory, stepper._scratch
    assert stepper._control_step(*args, action, 0, 7) == 7
    stepper._robosuite_substep()
    assert stepper._control_step(*args, action, 8, 25) == 25
    np.testing.assert_allclose(numbers(world), whole, atol=TOLERANCE)


def test_a_singular_matrix_is_noticed_before_the_substep(lift_world) -> None:
    lift_world.reset(np.random.default_rng(4))
    stepper = CompiledStepper(lift_world._env)
    assert stepper._memory["stale"].all()  # so the Jacobian below is used as it is
    before = lift_world._data.time, lift_world._data.qvel.copy()
    stepper._memory["jacobian"] = 0.0
    args = stepper._physics, stepper._arms, stepper._grippers, stepper._memory, stepper._scratch
    assert stepper._control_step(*args, np.zeros(7), 0, 25) == 0
    assert lift_world._data.time == before[0]
    np.testing.assert_array_equal(lift_world._data.qvel, before[1])


def test_what_is_not_covered_is_named(lift_world, monkeypatch) -> None:
    robosuite_world = make_world("Lift", "panda", 20, "robosuite")
    assert robosuite_world.step_backend == robosuite_world.spec.stepper == "robosuite"
    assert uncovered(robosuite_world._env) == ""
    with monkeypatch.context() as other:
        other.setattr(steppers, "MUJOCO", "0.0.0")
        assert "only 0.0.0" in uncovered(robosuite_world._env)
    part = robosuite_world._env.robots[0].composite_controller.part_controllers["right"]
    with monkeypatch.context() as other:
        other.setattr(part, "interpolator_pos", object())
        assert uncovered(robosuite_world._env) == "interpolators"
    with monkeypatch.context() as other:
        other.setattr(part, "impedance_mode", "variable")
        assert uncovered(robosuite_world._env) == "impedance_mode variable"
    robosuite_world._env.lite_physics = False
    assert uncovered(robosuite_world._env) == "lite_physics=False"
    with pytest.raises(SimulationError, match="does not cover lite_physics=False"):
        make_stepper("compiled", robosuite_world._env)
    assert make_stepper("auto", robosuite_world._env).name == "robosuite"
    with pytest.raises(UnknownName, match="unknown stepper 'compield'; known: auto, compiled, robosuite"):
        make_stepper("compield", robosuite_world._env)


def test_the_self_check_takes_robosuites_step_when_numbers_differ(monkeypatch, caplog) -> None:
    import lfd.worlds.robosuite_world as module

    monkeypatch.setattr(module, "compare", lambda world, actions: Comparison(0, ours=1e-3, itself=0.0))
    world = make_world("Lift", "panda", 20)
    assert world.step_backend == "robosuite"
    assert caplog.text.count("robosuite's own step is used") == 1
