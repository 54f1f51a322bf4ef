import mujoco
import numpy as np
import pytest

from lfd.core.errors import InputError, SimulationError
from lfd.interaction.table_people import BoltzmannHand
from lfd.worlds import shared_table
from lfd.worlds.shared_table import ABOVE_M, HAND_HOME, REST_M, SharedTableWorld, seen_table
from lfd.worlds.shared_table_guard import BALL_UP, GRIPPER_RADIUS, HAND_SPEED, LEAST_DISTANCE, TRACKING


class Someone:
    """Goes for a cube or straight at the gripper, as fast as they are let, or is one of the scene's people."""

    def __init__(self):
        self.does, self.boltzmann = "reach", BoltzmannHand("random", 0.3)

    def draw(self, rng):
        return self.boltzmann.draw(rng)

    def answer(self, theta, table, action, draw):
        if self.does == "choose":
            return self.boltzmann.answer(theta, table, action, draw)
        if self.does == "chase":
            return 9.0 * (table.gripper[:2] - table.hand)
        return 9.0 * ((table.cubes[int(theta[0])] if table.taken is None else np.array(HAND_HOME)) - table.hand)


@pytest.fixture(scope="module")
def person():
    return Someone()


@pytest.fixture(scope="module")
def kept(person):
    return SharedTableWorld(person, 5)


@pytest.fixture
def world(kept, person):
    person.does = "reach"
    return kept


def run(world, steps, rng):
    rows = []
    for _ in range(steps):
        world.step(rng.normal(0.0, 0.15, 3))
        rows.append(world.sim_state())
    return np.array(rows)


def test_the_same_generator_gives_the_same_episode_bit_for_bit(world) -> None:
    runs = []
    for _ in range(2):
        world.reset(np.random.default_rng(3))
        runs.append(run(world, 8, np.random.default_rng(4)))
    np.testing.assert_array_equal(*runs)


def test_a_state_decides_the_future_bit_for_bit(world) -> None:
    world.reset(np.random.default_rng(5))
    run(world, 12, np.random.default_rng(6))
    state = world.get_state()
    expected = run(world, 10, np.random.default_rng(7))
    world.reset(np.random.default_rng(8))
    world.set_state(state)
    np.testing.assert_array_equal(run(world, 10, np.random.default_rng(7)), expected)


def test_the_limit_holds_for_people_who_come_at_the_gripper_and_robots_that_go_for_the_hand(world, person) -> None:
    least, off = np.inf, 0.0
    for episode in range(6):
        rng = np.random.default_rng(100 + episode)
        seen, person.does = world.reset(rng), ("chase", "choose", "reach")[episode % 3]
        for step in range(40):
            table, hand = seen_table(seen), np.append(seen["hand_pos"][:2], 0.9)
            at = hand if episode < 3 else np.append(table.cubes[(episode + step // 25) % 3], REST_M + ABOVE_M)
            result = world.step(5.0 * (at - table.goal))
            seen = result.observation
            assert not result.failure
            assert seen["hand_distance"][0] >= LEAST_DISTANCE
            least = min(least, float(seen["hand_distance"][0]))
            off = max(off, float(np.linalg.norm(seen["ee_pos"] - seen["goal_point"])))
            if step % 15 == 0:
                assert farthest_of_gripper(world) <= GRIPPER_RADIUS
    assert least < 0.2  # they did meet
    assert 0.01 < off <= TRACKING


def farthest_of_gripper(world):
    """From the centre of the ball above the controller's grip site [m]."""
    model, data = world._arm._model, world._arm._data
    centre = world._arm.observe()[world._arm.layout["ee_pos"]] + np.array([0.0, 0.0, BALL_UP])
    farthest = 0.0
    for geom in world._solid:
        if not model.body(model.geom_bodyid[geom]).name.startswith("gripper0"):
            continue
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            begin = model.mesh_vertadr[mesh]
            points = model.mesh_vert[begin : begin + model.mesh_vertnum[mesh]]
        else:
            points = model.geom_size[geom] * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
        placed = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        farthest = max(farthest, float(np.linalg.norm(placed - centre, axis=1).max()))
    return farthest


def test_the_hand_is_no_faster_than_it_may_be_and_takes_the_cube_that_it_comes_to(world) -> None:
    seen = world.reset(np.random.default_rng(1))
    cube = int(world.get_state().memory["theta"][0])
    for _ in range(40):
        before = seen_table(seen)
        seen = world.step(np.array([0.0, 0.0, 0.1])).observation
        table = seen_table(seen)
        assert np.linalg.norm(table.hand - before.hand) <= HAND_SPEED * 0.2 + 1e-9
        if table.taken is not None:
            np.testing.assert_allclose(table.cubes[cube], table.hand, atol=2e-3)
    assert seen_table(seen).taken == cube
    np.testing.assert_allclose(seen["hand_pos"][:2], HAND_HOME, atol=0.1)


def test_the_robot_is_done_above_a_cube_that_nobody_took(world, person) -> None:
    seen = world.reset(np.random.default_rng(2))
    free = (int(world.get_state().memory["theta"][0]) + 1) % 3
    successes = []
    for _ in range(30):
        table = seen_table(seen)
        result = world.step(5.0 * (np.append(table.cubes[free], REST_M + ABOVE_M) - table.goal))
        seen = result.observation
        gap = np.linalg.norm(np.append(table.cubes[free], REST_M + ABOVE_M) - seen["ee_pos"])
        successes.append(result.success)
        assert result.success == (gap <= shared_table.NEAR_M)
    assert successes[-1]
    assert not successes[0]


def test_the_model_shows_hand_and_cubes_where_they_are(world) -> None:
    world.reset(np.random.default_rng(9))
    seen = world.step(np.zeros(3)).observation
    state = world.get_state()
    model = shared_table.load_model(state.model_xml)
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, np.array(state.sim), mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_kinematics(model, data)
    bodies = {"hand": "person_hand", **shared_table.BODIES}
    for name, body in bodies.items():
        np.testing.assert_allclose(data.body(body).xpos, seen[f"{name}_pos"], atol=1e-12)
    assert set(world.spec.labels) - {"action"} == set(seen)


def test_an_episode_breaks_off_where_what_the_proof_needs_does_not_hold(world, monkeypatch) -> None:
    world.reset(np.random.default_rng(0))
    monkeypatch.setattr(shared_table, "TRACKING", 1e-4)
    assert "off its goal" in world.step(np.array([0.2, 0.0, 0.0])).failure
    world.reset(np.random.default_rng(0))
    monkeypatch.setattr(shared_table, "LEAST_DISTANCE", 2.0)
    assert "the limit is 2.0 m" in world.step(np.zeros(3)).failure


def test_what_cannot_be_done_is_refused(world, person) -> None:
    with pytest.raises(InputError, match="finite velocity in x, y and z"):
        world.step(np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(InputError, match="give one of 1, 2, 4, 5, 10, 20"):
        SharedTableWorld(person, 3)
    state = world.get_state()
    with pytest.raises(SimulationError, match="make a world of its scene"):
        world.set_state(shared_table.replace(state, model_xml="<mujoco/>"))
    assert world.step(np.array([9.0, 0.0, 0.0])).clipped
