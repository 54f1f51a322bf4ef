import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lfd.bench.interaction import recipe_of
from lfd.interaction.driving_model import Goal, goal_reward
from lfd.interaction.driving_way_out import (
    ACCELERATIONS,
    AHEAD_S,
    DISC_M,
    MARGIN_M,
    Manoeuvres,
    discs,
    steering_to,
    with_a_way_out,
)
from lfd.interaction.scenes import scene_of
from lfd.loops.interacting import run_trial
from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, LENGTH, WIDTH, Car, separation

STEP_S = 0.2
places, angles, speeds = st.floats(-12.0, 12.0), st.floats(-3.1, 3.1), st.floats(0.0, 15.0)
cars = st.builds(Car, places, places, angles, speeds)


@given(cars, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_car_is_within_its_discs(car: Car, along: float, across: float) -> None:
    a, b, c, d = car.corners()
    point = (1 - along) * ((1 - across) * a + across * d) + along * ((1 - across) * b + across * c)
    centres = discs(np.array([car.x, car.y, car.yaw]))
    assert np.linalg.norm(centres - point, axis=1).min() <= DISC_M + 1e-9
    assert np.hypot(LENGTH, WIDTH) / 2.0 > DISC_M


@given(cars, cars)
def test_manoeuvres_are_driven_step_by_step_and_their_distances_are_not_above_those_of_the_outlines(
    robot, other
) -> None:
    lines = (robot.y, -3.5)
    found = Manoeuvres(robot, lines, STEP_S)
    distances, number = found.distances([other]), 0
    for acceleration in ACCELERATIONS:
        for line in lines:
            mine, there, least = robot, other, np.inf
            for step in range(round(AHEAD_S / STEP_S)):
                steering = float(steering_to(line, mine.y, mine.yaw, mine.speed, STEP_S))
                if step == 0:
                    np.testing.assert_allclose(found.first[number], [acceleration, steering])
                mine, there = mine.moved(acceleration, steering, STEP_S), there.moved(0.0, 0.0, STEP_S)
                least = min(least, separation(mine, there))
            assert distances[number] <= least + 1e-9
            number += 1
    assert number == len(distances)


@pytest.mark.parametrize("seed", range(20))
def test_who_always_speeds_up_does_not_hit_a_car_that_keeps_its_speed(seed: int) -> None:
    """Also where the control steps are shorter than those of the benchmark."""
    rng = np.random.default_rng(seed)
    heading, lane = (0.5 * np.pi, 0.0) if seed % 2 else (0.0, -3.5)
    robot, along = Car(-25.0, lane, 0.0, rng.uniform(5.0, 10.0)), -25.0 + rng.uniform(-8.0, 8.0)
    other = Car(along * np.cos(heading), along * np.sin(heading), heading, rng.uniform(5.0, 10.0))
    replaced, dt, steps = 0, *((STEP_S, 40) if seed < 10 else (0.05, 160))
    for _ in range(steps):
        wanted = np.array([ACTION_HIGH[0], rng.uniform(ACTION_LOW[1], ACTION_HIGH[1])])
        action = with_a_way_out(wanted, robot, [other], lane, dt)
        replaced += bool((action != wanted).any())
        robot, other = robot.moved(float(action[0]), float(action[1]), dt), other.moved(0.0, 0.0, dt)
        assert separation(robot, other) >= MARGIN_M - 1e-9
    assert replaced < steps


def test_an_action_that_leaves_a_way_out_is_carried_out() -> None:
    robot, far = Car(-25.0, 0.0, 0.0, 8.0), Car(0.0, -80.0, 0.5 * np.pi, 8.0)
    action = np.array([1.3, 0.01])
    assert with_a_way_out(action, robot, [far], 0.0, STEP_S) is action
    near, braking = Car(0.0, -9.0, 0.5 * np.pi, 8.0), np.array([ACTION_LOW[0], 0.0])
    assert with_a_way_out(braking, Car(-8.0, 0.0, 0.0, 10.0), [near], 0.0, STEP_S)[0] > -5.0  # would stop before it


@pytest.mark.parametrize("index", [69, 123])
def test_people_who_brake_less_than_planned_are_not_hit(index: int) -> None:
    """Two of the people whom robots without a way out hit."""
    (robot,) = scene_of("crossing").robots(("active",))
    trial = run_trial(recipe_of("crossing", index + 1, 2000), robot, index)
    assert not trial.collided
    assert trial.success


def test_a_blocked_lane_draws_robots_to_where_it_ends_soonest() -> None:
    """At rest on the line, without a car near: the last term is all there is."""
    goal = Goal(speed=0.0, danger=0.0, blocked=20.0, gap_m=10.0)
    still = tuple(torch.zeros(1, dtype=torch.float64) for _ in range(4))

    def reward(first: float, last: float) -> float:
        rows = [torch.full((1, 1), d, dtype=torch.float64) for d in (first, last)]
        cars = [(d, torch.full((1, 1), 9.0, dtype=torch.float64)) for d in rows]
        return float(goal_reward(goal, 0.0, torch.zeros(2, dtype=torch.float64), still, cars))

    assert reward(-2.0, 10.0) == pytest.approx(-20.0 * 1.2)
    assert reward(-8.0, 4.0) == pytest.approx(-20.0 * 1.4)
    assert reward(0.0, 12.0) == pytest.approx(-20.0)
    assert reward(5.0, 17.0) == pytest.approx(-20.0 * np.exp(-0.25))
    assert reward(-17.0, -5.0) == pytest.approx(-20.0 * np.exp(-0.25))
