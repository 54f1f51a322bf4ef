from dataclasses import replace

import mujoco
import numpy as np
import pytest

from lfd.core.errors import InputError, SimulationError, UnknownName
from lfd.interaction.driving_people import BoltzmannDriver
from lfd.worlds.car_following import CarFollowing
from lfd.worlds.driving_world import (
    ACTION_HIGH,
    LENGTH,
    SCENES,
    WHEELBASE,
    WIDTH,
    Car,
    DrivingWorld,
    least_distance,
    load_scene,
    seen_cars,
    seen_second,
    separation,
)


class Steady:
    """A person who never changes their speed."""

    def draw(self, rng):
        return np.array([rng.random()])

    def answer(self, theta, robot, person, action, draw):
        return 0.0


def world_of(name="merge", person=None):
    scene = load_scene(name)
    return DrivingWorld(scene, person or BoltzmannDriver(scene, "random", 0.3), 5)


def drive(world, steps, rng):
    rows = []
    for _ in range(steps):
        world.step(rng.uniform(-1.0, 1.0, 2) * ACTION_HIGH)
        rows.append(world.sim_state())
    return np.array(rows)


def test_a_bicycle_drives_the_circle_of_its_steering_angle() -> None:
    steering, dt, car = 0.05, 1e-3, Car(0.0, 0.0, 0.0, 8.0)
    for _ in range(5000):
        car = car.moved(0.0, steering, dt)
    radius = WHEELBASE / np.tan(steering)
    angle = 8.0 * 5.0 / radius
    assert car.yaw == pytest.approx(angle)
    np.testing.assert_allclose([car.x, car.y], radius * np.array([np.sin(angle), 1.0 - np.cos(angle)]), atol=5e-3)


def test_a_car_that_brakes_stands_still_and_does_not_reverse() -> None:
    car = Car(0.0, 0.0, 0.0, 1.0)
    for _ in range(10):
        car = car.moved(-5.0, 0.0, 0.2)
    assert car.speed == 0.0


def test_the_distance_of_two_cars_is_that_of_many_points_on_their_outlines(rng) -> None:
    for _ in range(40):
        cars = [Car(rng.uniform(-5.0, 5.0), rng.uniform(-5.0, 5.0), rng.uniform(-3.0, 3.0), 1.0) for _ in range(2)]
        part = np.linspace(0.0, 1.0, 120)[:, None]
        outlines = []
        for car in cars:
            corners = car.corners()
            sides = [a + part * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
            outlines.append(np.concatenate(sides))
        apart = np.linalg.norm(outlines[0][:, None] - outlines[1], axis=2).min()
        inside = [inside_of(a, outlines[1 - i]) for i, a in enumerate(cars)]
        expected = 0.0 if any(inside) else apart
        assert separation(*cars) == pytest.approx(expected, abs=0.05)


def inside_of(car, points):
    along = np.array([np.cos(car.yaw), np.sin(car.yaw)])
    ways = points - np.array([car.x, car.y]) - along * WHEELBASE / 2.0
    forward, left = ways @ along, ways @ np.array([-along[1], along[0]])
    return bool(((np.abs(forward) < LENGTH / 2.0) & (np.abs(left) < WIDTH / 2.0)).any())


@pytest.mark.parametrize("name", sorted(SCENES))
def test_the_same_generator_gives_the_same_episode_bit_for_bit(name) -> None:
    runs = []
    for _ in range(2):
        world = world_of(name)
        world.reset(np.random.default_rng(3))
        runs.append(drive(world, 20, np.random.default_rng(4)))
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_a_state_decides_the_future_bit_for_bit(name) -> None:
    world, other = world_of(name), world_of(name)
    world.reset(np.random.default_rng(5))
    drive(world, 7, np.random.default_rng(6))
    state = world.get_state()
    expected = drive(world, 15, np.random.default_rng(7))
    shown = other.set_state(state)
    assert seen_cars(shown)[0].speed > 0.0
    np.testing.assert_array_equal(drive(other, 15, np.random.default_rng(7)), expected)


def test_the_model_shows_the_cars_where_they_are() -> None:
    world = world_of()
    world.reset(np.random.default_rng(0))
    result = world.step(np.array([1.0, 0.03]))
    state = world.get_state()
    model = mujoco.MjModel.from_xml_string(state.model_xml)
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, np.array(state.sim), mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_kinematics(model, data)
    for car in ("robot_car", "person_car", "second_car"):
        np.testing.assert_allclose(data.body(car).xpos, result.observation[f"{car}_pos"], atol=1e-12)
        np.testing.assert_allclose(data.body(car).xquat, result.observation[f"{car}_quat"], atol=1e-12)


def test_an_episode_breaks_off_when_the_cars_touch() -> None:
    world = world_of(person=Steady())
    world.reset(np.random.default_rng(0))
    failures = [world.step(np.array([-1.0, 0.03])).failure for _ in range(15)]
    assert any("the cars touched" in failure for failure in failures)


def test_the_second_car_settles_at_its_headway_behind_the_first() -> None:
    law, lead, car, dt = CarFollowing(), Car(30.0, 0.0, 0.0, 13.0), Car(0.0, 0.0, 0.0, 16.0), 0.2
    for _ in range(300):
        a = law.acceleration(lead.x - car.x - LENGTH, car.speed, lead.speed)
        assert law.limits[0] <= a <= law.limits[1]
        lead, car = lead.moved(0.0, 0.0, dt), car.moved(a, 0.0, dt)
    assert car.speed == pytest.approx(13.0, abs=1e-3)
    assert lead.x - car.x - LENGTH == pytest.approx(2.0 + 0.4 * 13.0, abs=1e-2)


def test_the_second_car_brakes_for_a_robot_that_is_in_its_lane() -> None:
    world = world_of(person=Steady())
    seen = world.reset(np.random.default_rng(0))
    assert set(world.spec.labels) >= {"second_car_pos", "second_car_distance"}
    state, speeds = world.get_state(), {}
    for lateral in (-3.5, -1.0):
        sim = np.array(state.sim)
        start = mujoco.MjModel.from_xml_string(state.model_xml)
        data = mujoco.MjData(start)
        mujoco.mj_setState(start, data, sim, mujoco.mjtState.mjSTATE_INTEGRATION)
        data.qpos[:2] = seen["second_car_pos"][0] + LENGTH + 2.0, lateral
        mujoco.mj_getState(start, data, sim, mujoco.mjtState.mjSTATE_INTEGRATION)
        world.set_state(replace(state, sim=sim))
        before = seen_second(world.step(np.zeros(2)).observation)
        assert before is not None
        speeds[lateral] = before.speed
    assert speeds[-1.0] < speeds[-3.5] - 0.1


def test_a_lane_is_free_when_both_cars_are_clear() -> None:
    scene, robot, first = load_scene("merge"), Car(20.0, 0.1, 0.0, 15.0), Car(40.0, 0.0, 0.0, 15.0)
    assert scene.is_done(robot, first, Car(0.0, 0.0, 0.0, 15.0))
    assert not scene.is_done(robot, first, Car(14.5, 0.0, 0.0, 15.0))
    seen = world_of().reset(np.random.default_rng(1))
    assert least_distance(seen) == min(seen["person_car_distance"][0], seen["second_car_distance"][0])
    assert seen_second(world_of("crossing").reset(np.random.default_rng(1))) is None
    assert (scene.in_the_way, load_scene("crossing").in_the_way) == pytest.approx((WIDTH, (LENGTH + WIDTH) / 2.0))


def test_a_lane_is_changed_when_the_robot_is_in_it_and_clear() -> None:
    scene = load_scene("merge")
    assert scene.is_done(Car(20.0, 0.1, 0.0, 15.0), Car(0.0, 0.0, 0.0, 15.0))
    assert not scene.is_done(Car(20.0, -3.5, 0.0, 15.0), Car(0.0, 0.0, 0.0, 15.0))
    assert not scene.is_done(Car(6.0, 0.1, 0.0, 15.0), Car(0.0, 0.0, 0.0, 15.0))


def test_what_cannot_be_driven_is_refused() -> None:
    with pytest.raises(UnknownName, match="crossing, merge"):
        load_scene("roundabout")
    world = world_of(person=Steady())
    with pytest.raises(InputError, match="finite acceleration and steering"):
        world.step(np.array([np.nan, 0.0]))
    with pytest.raises(SimulationError, match="make a world of its scene"):
        world.set_state(world_of("crossing", Steady()).get_state())
    with pytest.raises(InputError, match="control_hz = 0"):
        DrivingWorld(load_scene("merge"), Steady(), 0)
    assert world.step(np.array([99.0, 0.0])).clipped
