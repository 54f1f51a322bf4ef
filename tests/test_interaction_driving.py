import numpy as np
import pytest
import torch
from torch.autograd.functional import hessian, jacobian

from lfd.core.errors import InputError, UnknownName
from lfd.interaction.driving_model import (
    COAST,
    STEP_S,
    TYPES,
    Situation,
    by_controls,
    hardest_braking,
    person_derivatives,
    person_reward,
)
from lfd.interaction.driving_people import ACCELERATIONS, LOOK_AHEAD, BoltzmannDriver, choices_now, type_of
from lfd.interaction.driving_robots import DriverOptions, InteractiveDriver
from lfd.interaction.interactive_robot import KINDS
from lfd.interaction.receding_horizon import Limits, RecedingHorizon, shifted
from lfd.interaction.responses import best_response
from lfd.interaction.stackelberg import leader_gradient, plan_stackelberg
from lfd.worlds.car_following import CarFollowing
from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, LENGTH, Car, DrivingWorld, load_scene

MERGE = load_scene("merge")
ROBOT, PERSON = Car(6.0, -3.0, 0.05, 14.5), Car(0.0, 0.0, 0.0, 15.2)
NOW = Situation(MERGE, ROBOT, PERSON)


def test_the_path_in_closed_form_is_that_of_the_worlds_steps(rng) -> None:
    u = rng.uniform(np.tile(ACTION_LOW, 5), np.tile(ACTION_HIGH, 5))
    x, y, yaw, speed = NOW.robot_path(torch.from_numpy(u))
    way, person_speed = NOW.person_path(torch.from_numpy(u[::2]))
    car, person = ROBOT, PERSON
    for step, (a, steering) in enumerate([*u.reshape(5, 2).tolist(), *[(0.0, 0.0)] * COAST]):
        car, person = car.moved(a, steering, STEP_S), person.moved(a, 0.0, STEP_S)
        there = [float(row[step]) for row in (x, y, yaw, speed, way, person_speed)]
        np.testing.assert_allclose(there, [car.x, car.y, car.yaw, car.speed, person.x, person.speed], atol=1e-12)


@pytest.mark.parametrize("speed", [0.0, 3.3, 15.0])
def test_people_in_plans_brake_as_hard_as_they_can_and_do_not_drive_backwards(speed, rng) -> None:
    low = hardest_braking(speed, 5)
    car = Car(0.0, 0.0, 0.0, speed)
    now = Situation(MERGE, ROBOT, car)
    way, speeds = now.person_path(low)
    for step in range(5):
        car = car.moved(-4.0, 0.0, STEP_S)
        assert float(speeds[step]) == pytest.approx(car.speed)
        assert float(way[step]) == pytest.approx(car.x)
    _, others = now.person_path(low + torch.from_numpy(rng.uniform(0.0, 2.0, (50, 5))))
    assert (others >= 0.0).all()


def test_the_second_cars_path_in_closed_form_is_that_of_steps_by_its_law(rng) -> None:
    law, second = CarFollowing(), Car(-13.0, 0.0, 0.0, 14.0)
    now, u = Situation(MERGE, ROBOT, PERSON, second), rng.uniform(-3.0, 2.0, (3, 5))
    ways = now.second_path(torch.from_numpy(u), follows=True)
    steady = now.second_path(torch.from_numpy(u), follows=False)
    for row, each in enumerate(u):
        person, car = PERSON, second
        for step, a in enumerate([*each.tolist(), *[0.0] * COAST]):
            wish = law.wish(person.x - car.x - LENGTH, car.speed, person.speed)
            person, car = person.moved(a, 0.0, STEP_S), car.moved(wish, 0.0, STEP_S)
            assert float(ways[row, step]) == pytest.approx(car.x - second.x, abs=1e-9)
            assert float(steady[row, step]) == pytest.approx((step + 1) * STEP_S * second.speed)


def test_the_persons_derivatives_in_closed_form_are_automatic_ones(rng) -> None:
    theta = torch.tensor([[0.04, 0.25, 40.0, 3.0], [0.1, 0.3, 5.0, 40.0]], dtype=torch.float64)
    x, y, _, _ = NOW.robot_path(torch.from_numpy(0.7 * rng.uniform(np.tile(ACTION_LOW, 5), np.tile(ACTION_HIGH, 5))))
    u = torch.from_numpy(rng.uniform(-3.0, 2.0, (2, 5)))

    def seen(u):
        way, speed = NOW.person_path(u)
        return *NOW.from_person(x[None], y[None], way), speed, u

    def reward(u):
        d, e, speed, u = seen(u)
        return person_reward(MERGE, theta, d, e, speed, u).sum()

    way, rate, one = (torch.from_numpy(each) for each in by_controls(5))
    value, g, blocks = person_derivatives(torch.exp, (way, rate, one), MERGE, theta, seen(u))
    assert float(value.sum()) == pytest.approx(float(reward(u)))
    torch.testing.assert_close(g, jacobian(reward, u))
    whole = -torch.as_tensor(hessian(reward, u))
    for k in range(2):
        torch.testing.assert_close(blocks[k], whole[k, :, k])
    assert whole[0, :, 1].abs().max() == 0.0
    d, e, speed, _ = (each.numpy() for each in seen(u))
    arrays = d, e, speed, u.numpy()
    for one_way, other in zip(
        person_derivatives(np.exp, by_controls(5), MERGE, theta.numpy(), arrays), (value, g, blocks), strict=True
    ):
        np.testing.assert_allclose(one_way, other.numpy(), atol=1e-10)


def test_choices_are_boltzmanns_over_rewards_summed_step_by_step() -> None:
    theta, action = torch.tensor(list(TYPES.values()), dtype=torch.float64), np.array([0.7, 0.02])
    logs = choices_now(NOW, theta, action, 0.3)
    rows = []
    for weights in theta:
        rewards = []
        for a in ACCELERATIONS.tolist():
            robot, person, value = ROBOT, PERSON, 0.0
            for step in range(LOOK_AHEAD["merge"]):
                acceleration, steering = action.tolist() if step == 0 else (0.0, 0.0)
                robot = robot.moved(acceleration, steering, STEP_S)
                person = person.moved(a, 0.0, STEP_S)
                row = [torch.tensor([v], dtype=torch.float64) for v in (robot.x - person.x, robot.y, person.speed, a)]
                value += float(person_reward(MERGE, weights, *row))
            rewards.append(0.3 * value)
        rows.append(torch.log_softmax(torch.tensor(rewards, dtype=torch.float64), 0))
    torch.testing.assert_close(logs, torch.stack(rows), atol=1e-10, rtol=0.0)


def test_people_choose_as_often_as_their_probabilities_say(rng) -> None:
    driver = BoltzmannDriver(MERGE, "passive", 0.3)
    theta, action = np.array(TYPES["passive"]), np.zeros(2)
    drawn = [driver.answer(theta, ROBOT, PERSON, action, draw) for draw in rng.random(1500)]
    expected = choices_now(NOW, torch.from_numpy(theta)[None], action, 0.3)[0].exp()
    shares = [np.mean(np.isclose(drawn, a)) for a in ACCELERATIONS.tolist()]
    np.testing.assert_allclose(shares, expected.numpy(), atol=0.05)
    best = BoltzmannDriver(MERGE, "passive", np.inf).answer(theta, ROBOT, PERSON, action, 0.5)
    assert best == float(ACCELERATIONS[int(expected.argmax())])


def test_passive_people_brake_for_who_leans_in_and_aggressive_ones_do_not() -> None:
    leaning = Situation(MERGE, Car(7.0, -2.5, 0.06, 15.0), Car(0.0, 0.0, 0.0, 15.0))
    names = sorted(TYPES)
    theta = torch.tensor([TYPES[name] for name in names], dtype=torch.float64)
    mean = dict(zip(names, (choices_now(leaning, theta, np.zeros(2), 1.0).exp() @ ACCELERATIONS).tolist(), strict=True))
    assert mean["passive"] < -1.5 < -0.5 < mean["aggressive"]
    assert [type_of(np.array(TYPES[name])) for name in names] == names


def test_the_gradient_through_people_of_several_types_is_that_of_finite_differences() -> None:
    robot = InteractiveDriver(MERGE, 5, DriverOptions(kind="active"))
    robot.reset(np.random.default_rng(0))
    u = 0.5 * robot._starts(ROBOT)[0]

    def follower(a, b):
        return robot._person_reward(NOW, a, b)

    def leader(a, b):
        return robot._robot_reward(NOW, a, b)

    def answer(a):
        return best_response(follower, a, torch.zeros(10, dtype=torch.float64), bounds=(-4.0, 2.5), followers=2)

    gradient = leader_gradient(leader, follower, u, answer(u), bounds=(-4.0, 2.5), followers=2)
    torch.testing.assert_close(gradient, leader_gradient(leader, follower, u, answer(u), bounds=(-4.0, 2.5)))

    def closed(a, b):
        return robot._person_derivatives(NOW, a, b)

    known = {"bounds": (-4.0, 2.5), "followers": 2, "derivatives": closed}
    torch.testing.assert_close(gradient, leader_gradient(leader, follower, u, answer(u), **known))
    torch.testing.assert_close(answer(u), best_response(follower, u, torch.zeros(10, dtype=torch.float64), **known))
    for place in (0, 1, 4, 7):
        step = torch.zeros(10, dtype=torch.float64)
        step[place] = 1e-6
        ends = [float(leader(u + sign * step, answer(u + sign * step))) for sign in (1.0, -1.0)]
        assert float(gradient[place]) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4, abs=1e-5)


def test_plans_stay_within_limits_and_begin_with_the_last_one_shifted() -> None:
    def person(u_robot, u_human):
        return -((u_human - 0.5 * u_robot) ** 2).sum(-1)

    def robot(u_robot, u_human):
        return -((u_robot - 3.0) ** 2).sum(-1) - (u_human**2).sum(-1)

    planner = RecedingHorizon(Limits(robot=(-1.0, 2.0), person=(-5.0, 5.0), gradients=20))
    starts, none = torch.zeros(3, 4, dtype=torch.float64), torch.zeros(4, dtype=torch.float64)
    plan = planner.plan(robot, person, starts, none, shift=0.5, controls=1, followers=1)
    torch.testing.assert_close(plan.u_robot, torch.full((4,), 2.0, dtype=torch.float64))
    short = RecedingHorizon(Limits(robot=(-1.0, 2.0), person=(-5.0, 5.0), gradients=1))
    first = short.plan(robot, person, starts, none, shift=0.5, controls=1, followers=1)
    assert short.plan(robot, person, starts, none, shift=0.5, controls=1, followers=1).value >= first.value
    with pytest.raises(InputError, match="starts hold"):
        planner.plan(robot, person, starts + 9.0, none, shift=0.5, controls=1, followers=1)
    with pytest.raises(InputError, match="gradients = 0"):
        RecedingHorizon(Limits(robot=(-1.0, 2.0), person=(-5.0, 5.0), gradients=0))


def test_controls_that_have_half_passed_are_interpolated() -> None:
    u = torch.tensor([0.0, 10.0, 2.0, 20.0, 4.0, 30.0], dtype=torch.float64)
    torch.testing.assert_close(shifted(u, 0.5, 2), torch.tensor([1.0, 15.0, 3.0, 25.0, 4.0, 30.0], dtype=torch.float64))
    two = shifted(torch.tensor([0.0, 2.0, 8.0, 4.0], dtype=torch.float64), 1.0, 1, followers=2)
    torch.testing.assert_close(two, torch.tensor([2.0, 2.0, 4.0, 4.0], dtype=torch.float64))


def test_implicit_and_finite_differences_plan_alike_and_the_first_solves_far_less() -> None:
    def person(u_robot, u_human):
        return -((u_human + 0.8 * torch.tanh(u_robot)) ** 2).sum() - 0.1 * (u_human**4).sum()

    def robot(u_robot, u_human):
        return -((u_robot - 0.3) ** 2).sum() - ((u_human + 0.7) ** 2).sum()

    start = torch.zeros(10, dtype=torch.float64)
    implicit = plan_stackelberg(robot, person, start, start)
    plain = plan_stackelberg(robot, person, start, start, difference=1e-5)
    torch.testing.assert_close(implicit.u_robot, plain.u_robot, atol=1e-4, rtol=0.0)
    assert plain.human_solves > 15 * implicit.human_solves


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_drives_within_its_limits_and_is_deterministic(kind) -> None:
    runs = []
    for _ in range(2):
        world = DrivingWorld(MERGE, BoltzmannDriver(MERGE, "random", 0.3), 5)
        robot = InteractiveDriver(MERGE, 5, DriverOptions(kind=kind))
        seen = world.reset(np.random.default_rng(1))
        robot.reset(np.random.default_rng(1))
        for _ in range(5):
            decision = robot.act(seen)
            assert ("belief" in decision.signals) == (kind in ("passive", "active"))
            result = world.step(decision.action)
            assert not result.clipped
            seen = result.observation
        runs.append(world.sim_state())
    np.testing.assert_array_equal(*runs)


def test_a_belief_comes_to_know_the_person_whom_it_watches() -> None:
    world = DrivingWorld(MERGE, BoltzmannDriver(MERGE, "passive", 0.3), 5)
    robot = InteractiveDriver(MERGE, 5, DriverOptions(kind="active"))
    seen = world.reset(np.random.default_rng(2))
    robot.reset(np.random.default_rng(2))
    for _ in range(15):
        seen = world.step(robot.act(seen).action).observation
    assert robot.belief["passive"] > 0.9


def test_options_that_are_none_are_refused() -> None:
    for options, said in (
        (DriverOptions(kind="shy"), "unknown robot kind 'shy'"),
        (DriverOptions(kind="known", assumed="rude"), "unknown type of person 'rude'"),
        (DriverOptions(kind="active", goal_weight=0.0), "goal_weight = 0.0"),
    ):
        with pytest.raises(InputError, match=said):
            InteractiveDriver(MERGE, 5, options)
    with pytest.raises(UnknownName, match="unknown person 'rude'"):
        BoltzmannDriver(MERGE, "rude", 1.0)
    with pytest.raises(InputError, match="rationality = 0"):
        BoltzmannDriver(MERGE, "random", 0.0)
