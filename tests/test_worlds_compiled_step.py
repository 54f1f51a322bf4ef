import numpy as np
import pytest

from lfd import make_world
from lfd.core.errors import SimulationError, UnknownName
from lfd.worlds import steppers
from lfd.worlds.robosuite_world import RobosuiteWorld
from lfd.worlds.robots import RobotConfig
from lfd.worlds.steppers import CompiledStepper, make_stepper, uncovered


def numbers(world) -> np.ndarray:
    return np.concatenate([world._data.qpos, world._data.qvel, world._data.ctrl])


def both_ways(world, actions) -> tuple[np.ndarray, np.ndarray]:
    """qpos, qvel and ctrl after each control step, compiled and by robosuite, from the present state."""
    start, results = world.get_state(), []
    for name in ("compiled", "robosuite"):
        world.set_state(start)
        stepper = make_stepper(name, world._env)
        rows = []
        for action in actions:
            stepper.step(action)
            rows.append(numbers(world))
        results.append(np.array(rows))
    return results[0], results[1]


@pytest.fixture(scope="module")
def position_world() -> RobosuiteWorld:
    config = RobotConfig(robosuite_name="Panda", controller="OSC_POSITION")
    return RobosuiteWorld(task="Lift", robot_name="panda", robot=config, control_hz=20)


@pytest.mark.parametrize("controller", ["OSC_POSE", "OSC_POSITION"])
def test_ten_control_steps_give_robosuites_numbers(controller, lift_world, position_world, rng) -> None:
    """From a reset, whose first substep still uses the controllers' construction, and from mid-episode."""
    world = lift_world if controller == "OSC_POSE" else position_world
    assert world.step_backend == "compiled"
    size = len(world.spec.action_low)
    for seed in range(3):
        world.reset(np.random.default_rng(seed))
        for _ in range(2):
            ours, theirs = both_ways(world, rng.uniform(-1.5, 1.5, (10, size)))  # beyond the limits: clipped alike
            assert np.abs(ours - theirs).max() <= 1e-9


def test_a_grasp_gives_robosuites_numbers(lift_world) -> None:
    """Contacts are chaotic: the yardstick is robosuite against itself, its start moved by 1e-15."""
    from lfd import make_expert

    expert = make_expert(lift_world.spec)
    seen = lift_world.reset(np.random.default_rng(0))
    for _ in range(20):
        seen = lift_world.step(expert.act(seen).action).observation
    actions = np.tile([0.0, 0, 1, 0, 0, 0, 1], (10, 1))
    start = lift_world.get_state()
    ours, theirs = both_ways(lift_world, actions)
    lift_world.set_state(start)
    lift_world._data.qpos[0] += 1e-15
    _, moved = both_ways(lift_world, actions)
    assert np.abs(ours - theirs).max() <= max(1e-9, 10 * np.abs(moved - theirs).max())


def test_a_substep_left_to_robosuite_fits_in(lift_world, rng) -> None:
    """What happens at a singular matrix, made to happen in the middle of a step."""
    lift_world.reset(np.random.default_rng(4))
    action = rng.uniform(-1, 1, 7)
    start = lift_world.get_state()
    whole, _ = both_ways(lift_world, [action])
    lift_world.set_state(start)
    stepper = CompiledStepper(lift_world._env)
    stepper._close(action[6:])
    pieces = [(0, 7), (8, 25)]
    for begin, end in pieces:
        memory = stepper._memory()
        at = stepper._control_step(stepper._physics, stepper._arm, memory, action, *stepper._goal, begin, end)
        assert at == end
        if end < 25:
            stepper._robosuite_substep()
    np.testing.assert_allclose(numbers(lift_world), whole[0], atol=1e-9)


def test_a_singular_matrix_is_noticed_before_the_substep(lift_world) -> None:
    lift_world.reset(np.random.default_rng(4))
    stepper = CompiledStepper(lift_world._env)
    memory = stepper._memory()
    assert memory.stale
    before = lift_world.sim_state()
    flat = memory._replace(jacobian=np.zeros((6, 7)))
    assert stepper._control_step(stepper._physics, stepper._arm, flat, np.zeros(7), *stepper._goal, 0, 25) == 0
    np.testing.assert_array_equal(lift_world.sim_state(), before)


def test_what_is_not_covered_is_named(lift_world, monkeypatch) -> None:
    robosuite_world = make_world("Lift", "panda", 20, "robosuite")
    assert robosuite_world.step_backend == robosuite_world.spec.stepper == "robosuite"
    assert uncovered(robosuite_world._env) == ""
    with monkeypatch.context() as other:
        other.setattr(steppers, "MUJOCO", "0.0.0")
        assert "only 0.0.0" in uncovered(robosuite_world._env)
    robosuite_world._env.lite_physics = False
    assert uncovered(robosuite_world._env) == "lite_physics=False"
    with pytest.raises(SimulationError, match="does not cover lite_physics=False"):
        make_stepper("compiled", robosuite_world._env)
    assert make_stepper("auto", robosuite_world._env).name == "robosuite"
    with pytest.raises(UnknownName, match="unknown stepper 'compield'; known: auto, compiled, robosuite"):
        make_stepper("compield", robosuite_world._env)


def test_the_self_check_takes_robosuites_step_when_numbers_differ(lift_world, monkeypatch, caplog) -> None:
    import lfd.worlds.robosuite_world as module

    monkeypatch.setattr(module, "SELF_CHECK_TOLERANCE", -1.0)
    world = make_world("Lift", "panda", 20)
    assert world.step_backend == "robosuite"
    assert "robosuite's own step is used" in caplog.text
