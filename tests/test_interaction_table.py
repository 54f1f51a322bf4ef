import numpy as np
import pytest
import torch
from torch.func import hessian, jacrev

from lfd.core.errors import InputError, UnknownName
from lfd.interaction.interactive_robot import KINDS
from lfd.interaction.responses import best_response
from lfd.interaction.stackelberg import leader_gradient
from lfd.interaction.table_model import (
    EFFORT,
    KEEP_OFF_M,
    REACH,
    SMOOTH_M,
    STEP_S,
    TOUCH,
    TOUCH_M,
    TYPES,
    person_derivatives,
    person_reward,
    reach_now,
)
from lfd.interaction.table_people import LOOK_AHEAD, VELOCITIES, BoltzmannHand, choices_now, type_of
from lfd.interaction.table_robots import InteractiveReacher, ReacherOptions
from lfd.worlds.shared_table import HAND_HIGH, HAND_HOME, HAND_LOW, Table
from lfd.worlds.shared_table_guard import BALL_UP, GOAL_SPEED, HAND_HEIGHT, HAND_SPEED

CUBES = np.array([[0.04, 0.32], [0.04, 0.0], [0.04, -0.32]])


def table(gripper=(-0.18, 0.0, 1.05), hand=(0.38, 0.02), taken=None):
    return Table(np.array(gripper), np.array(gripper), np.array(hand), CUBES.copy(), taken)


def seen(now):
    """The observation that shows a table."""
    heights = [0.9 if i == now.taken else 0.826 for i in range(3)]
    cubes = {f"{name}_pos": np.append(now.cubes[i], heights[i]) for i, name in enumerate(("left", "middle", "right"))}
    return {**cubes, "ee_pos": now.gripper, "goal_point": now.goal, "hand_pos": np.append(now.hand, HAND_HEIGHT)}


def reward_by_hand(now, theta, velocity, action):
    """R_H of one velocity, held, step by step as its formula says; the gripper moves for one step, at its limit."""
    cube, yielding = int(theta[0]), theta[1]
    target = np.array(HAND_HOME) if now.taken is not None else now.cubes[cube]
    speed = np.linalg.norm(action)
    gripper = now.goal + STEP_S * action * min(1.0, GOAL_SPEED / max(speed, 1e-12))
    total = 0.0
    for k in range(1, LOOK_AHEAD + 1):
        hand = np.clip(now.hand + k * STEP_S * velocity, HAND_LOW, HAND_HIGH)
        apart = np.linalg.norm([*(gripper[:2] - hand), gripper[2] + BALL_UP - HAND_HEIGHT])
        total -= REACH * np.sqrt(np.sum((hand - target) ** 2) + SMOOTH_M**2)
        total -= EFFORT * np.sum(velocity**2) / HAND_SPEED**2
        total -= yielding * np.exp(-((apart / KEEP_OFF_M) ** 2)) + TOUCH * np.exp(-((apart / TOUCH_M) ** 2))
    return total


def likelihoods_by_hand(now, theta, action, rationality):
    weights = np.exp([rationality * reward_by_hand(now, theta, v, action) for v in VELOCITIES.numpy()])
    return weights / weights.sum()


@pytest.mark.parametrize("taken", [None, 2])
def test_a_belief_is_updated_as_by_brute_force_with_the_normaliser_of_each_theta(taken) -> None:
    robot = InteractiveReacher(5, ReacherOptions(kind="passive"))
    robot.reset(np.random.default_rng(0))
    now = table(gripper=(0.0, 0.02, 0.95), hand=(0.25, 0.03), taken=taken)
    expected = {name: 1.0 / len(TYPES) for name in TYPES}
    for number in (3, 17, 20):
        action = robot.act(seen(now)).action
        for name, theta in TYPES.items():
            expected[name] *= likelihoods_by_hand(now, theta, action, 0.3)[number]
        moved = np.clip(now.hand + 0.2 * VELOCITIES[number].numpy(), HAND_LOW, HAND_HIGH)
        gripper = now.gripper + np.array([0.0, 0.0, 0.01])
        now = Table(gripper, gripper, moved, now.cubes, taken)
    robot.act(seen(now))
    total = sum(expected.values())
    for name in TYPES:
        assert robot.belief[name] == pytest.approx(expected[name] / total, rel=1e-8)


def test_the_normaliser_depends_on_theta() -> None:
    now = table(gripper=(0.04, 0.0, 0.9), hand=(0.25, 0.0))
    rewards = {n: [reward_by_hand(now, t, v, np.zeros(3)) for v in VELOCITIES.numpy()] for n, t in TYPES.items()}
    logs = {name: np.log(np.exp(0.3 * np.array(of)).sum()) for name, of in rewards.items()}
    assert max(logs.values()) - min(logs.values()) > 0.5


def test_people_choose_by_boltzmanns_distribution_or_what_is_best() -> None:
    person, now, action = BoltzmannHand("random", 0.3), table(), np.array([0.1, 0.0, -0.1])
    theta = np.array(TYPES["left-yields"])
    expected = likelihoods_by_hand(now, theta, action, 0.3)
    drawn = [person.answer(theta, now, action, (i + 0.5) / 2000) for i in range(2000)]
    shares = [np.mean([np.allclose(u, v) for u in drawn]) for v in VELOCITIES.numpy()]
    np.testing.assert_allclose(shares, expected, atol=1e-3)
    best = BoltzmannHand("random", np.inf).answer(theta, now, action, 0.5)
    np.testing.assert_array_equal(best, VELOCITIES[int(expected.argmax())].numpy())


def test_who_yields_keeps_off_a_gripper_at_their_cube_and_who_insists_does_not() -> None:
    now = table(gripper=(0.04, 0.0, 0.89), hand=(0.34, 0.0))
    ways = {}
    for name in ("middle-yields", "middle-insists"):
        theta = torch.tensor([TYPES[name]], dtype=torch.float64)
        ways[name] = float((choices_now(now, theta, np.zeros(3), 0.3).exp() @ VELOCITIES)[0, 0])
    assert ways["middle-insists"] < -0.03
    assert ways["middle-yields"] > 0.0


def test_a_person_is_of_the_type_that_was_asked_for() -> None:
    rng = np.random.default_rng(0)
    assert {type_of(BoltzmannHand("random", 0.3).draw(rng)) for _ in range(80)} == set(TYPES)
    assert {type_of(BoltzmannHand("yields", 0.3).draw(rng)).partition("-")[2] for _ in range(20)} == {"yields"}
    assert {type_of(BoltzmannHand("left-insists", 0.3).draw(rng)) for _ in range(5)} == {"left-insists"}
    with pytest.raises(UnknownName, match="unknown person 'shy'"):
        BoltzmannHand("shy", 0.3)
    with pytest.raises(InputError, match="rationality = 0"):
        BoltzmannHand("random", 0.0)


@pytest.mark.parametrize("taken", [None, 0])
def test_derivatives_in_closed_form_are_automatic_ones(taken) -> None:
    generator = torch.Generator().manual_seed(0)
    now = reach_now(table(gripper=(0.05, 0.1, 0.9), hand=(0.2, 0.05), taken=taken))
    theta = torch.tensor([TYPES["left-insists"], TYPES["middle-yields"]], dtype=torch.float64)
    u_robot = 0.1 * torch.randn(15, generator=generator, dtype=torch.float64)
    u = 0.1 * torch.randn(2, 2, 5, generator=generator, dtype=torch.float64)

    def reward(u):
        path = now.robot_path(u_robot)[None]
        return person_reward(theta, now.targets(theta), path, now.person_path(u), (u**2).sum(-2))

    value, g, blocks = person_derivatives(
        theta, now.targets(theta), now.robot_path(u_robot)[None], now.person_path(u), u
    )
    torch.testing.assert_close(value, reward(u))
    torch.testing.assert_close(g, jacrev(lambda u: reward(u).sum())(u).flatten(1))
    whole = hessian(lambda u: reward(u).sum())(u).reshape(2, 10, 2, 10)
    torch.testing.assert_close(blocks, -torch.stack([whole[i, :, i] for i in range(2)]))
    assert float(whole[0, :, 1].abs().max()) == 0.0


@pytest.mark.parametrize("kind", ["passive", "active"])
def test_the_gradient_through_people_of_six_types_is_that_of_finite_differences(kind) -> None:
    robot = InteractiveReacher(5, ReacherOptions(kind=kind))
    robot.reset(np.random.default_rng(0))
    now = reach_now(table(gripper=(-0.05, 0.05, 0.95), hand=(0.25, 0.05)))
    keeps = torch.zeros(2, dtype=torch.float64)
    u = 0.6 * robot._starts(now)[1] + 0.01

    def follower(a, b):
        return robot._person_reward(now, keeps, a, b)

    def leader(a, b):
        return robot._robot_reward(now, a, b)

    def answer(a):
        begin = torch.zeros(60, dtype=torch.float64)
        return best_response(follower, a, begin, bounds=(-HAND_SPEED, HAND_SPEED), followers=6)

    gradient = leader_gradient(leader, follower, u, answer(u), bounds=(-HAND_SPEED, HAND_SPEED), followers=6)
    for place in (0, 1, 2, 7, 11):
        step = torch.zeros(15, dtype=torch.float64)
        step[place] = 1e-5
        ends = [float(leader(u + sign * step, answer(u + sign * step))) for sign in (1.0, -1.0)]
        assert float(gradient[place]) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_robot_plans_within_its_limits_and_is_deterministic(kind) -> None:
    runs = []
    for _ in range(2):
        robot = InteractiveReacher(5, ReacherOptions(kind=kind))
        robot.reset(np.random.default_rng(1))
        actions = []
        for step in range(3):
            decision = robot.act(seen(table(hand=(0.38 - 0.02 * step, 0.02), gripper=(-0.18, 0.0, 1.05 - 0.02 * step))))
            assert ("belief" in decision.signals) == (kind in ("passive", "active"))
            assert np.abs(decision.action).max() <= GOAL_SPEED
            actions.append(decision.action)
        runs.append(np.array(actions))
    np.testing.assert_array_equal(*runs)


def test_a_robot_leaves_a_cube_to_the_person_who_is_known_to_insist_on_it() -> None:
    for side, name in ((1.0, "left"), (-1.0, "right")):
        ways = {}
        for manner in ("insists", "yields"):
            robot = InteractiveReacher(5, ReacherOptions(kind="known", assumed=f"{name}-{manner}"))
            robot.reset(np.random.default_rng(0))
            begin = (0.04, 0.18 * side, 0.95)  # a little nearer to the cube at the side than to the middle one
            ways[manner] = side * robot.act(seen(table(gripper=begin, hand=(0.45, 0.0)))).action[1]
        assert ways["insists"] < -0.05
        assert ways["yields"] > 0.05


def test_where_the_hand_stays_at_the_edge_of_its_reach_all_that_ends_there_counts() -> None:
    robot = InteractiveReacher(5, ReacherOptions(kind="passive"))
    robot.reset(np.random.default_rng(0))
    now = table(hand=(HAND_HIGH[0], 0.0))
    action = robot.act(seen(now)).action
    robot.act(seen(now))
    outwards = [
        i for i, v in enumerate(VELOCITIES.numpy())
        if np.allclose(np.clip(now.hand + 0.2 * v, HAND_LOW, HAND_HIGH), now.hand)
    ]  # fmt: skip
    assert len(outwards) == 3
    expected = np.array([likelihoods_by_hand(now, TYPES[n], action, 0.3)[outwards].sum() for n in sorted(TYPES)])
    np.testing.assert_allclose(list(robot.belief.values()), expected / expected.sum(), rtol=1e-8)


def test_options_that_are_none_are_refused() -> None:
    for options, said in (
        (ReacherOptions(kind="shy"), "unknown robot kind 'shy'"),
        (ReacherOptions(kind="known", assumed="rude"), "unknown type of person 'rude'"),
        (ReacherOptions(kind="active", goal_weight=0.0), "goal_weight = 0.0"),
    ):
        with pytest.raises(InputError, match=said):
            InteractiveReacher(5, options)
