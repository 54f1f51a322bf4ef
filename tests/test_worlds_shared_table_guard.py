import numpy as np
import pytest

from lfd.worlds.shared_table_guard import (
    ALLOWED,
    BALL_UP,
    GOAL_HIGH,
    GOAL_LOW,
    GOAL_SPEED,
    HAND_HEIGHT,
    HAND_SPEED,
    RETREATS,
    SAFE_HEIGHT,
    SEPARATION,
    STIFFNESS,
    TICK_S,
    TRACKING,
    guarded,
    is_allowed,
    margins,
)

LOW, HIGH = np.array([-0.1, -0.45]), np.array([0.5, 0.45])


def away(goal, hand):
    return float(np.linalg.norm([*(goal[:2] - hand), goal[2] + BALL_UP - HAND_HEIGHT]))


def allowed_state(rng):
    while True:
        goal, hand = rng.uniform(GOAL_LOW, GOAL_HIGH), rng.uniform(LOW, HIGH)
        if is_allowed(goal, hand):
            return goal, hand


def test_a_margin_is_the_least_distance_of_a_retreat_less_the_hands_way(rng) -> None:
    for _ in range(6):
        goal, hand = rng.uniform(GOAL_LOW, GOAL_HIGH), rng.uniform(LOW, HIGH)
        found = margins(goal, hand)
        for i in rng.choice(len(RETREATS), 6, replace=False):
            n = RETREATS[i]
            longest = max(SAFE_HEIGHT - goal[2] - BALL_UP, 0.0) / (GOAL_SPEED * n[2])
            t = np.linspace(0.0, longest, 2001)
            goals = goal + GOAL_SPEED * t[:, None] * n
            if (goals[-1] < GOAL_LOW - 1e-9).any() or (goals[-1] > GOAL_HIGH + 1e-9).any():
                assert found[i] == -np.inf
            else:
                least = min(away(g, hand) - HAND_SPEED * at for g, at in zip(goals, t, strict=True))
                assert found[i] == pytest.approx(least, abs=1e-6)


def test_after_an_allowed_goal_there_is_another_one_wherever_the_hand_went(rng) -> None:
    for _ in range(300):
        goal, hand = allowed_state(rng)
        way = rng.normal(size=2)
        step = HAND_SPEED * TICK_S * way / np.linalg.norm(way)
        towards = goal[:2] - hand
        if rng.random() < 0.5:
            step = HAND_SPEED * TICK_S * towards / np.linalg.norm(towards)
        then = guarded(goal, hand + step, rng.normal(size=3))
        assert is_allowed(then, hand + step)
        assert away(then, hand + step) >= SEPARATION


@pytest.mark.parametrize("robot", ["at the hand", "anywhere", "still"])
@pytest.mark.parametrize("person", ["at the gripper", "anywhere", "where the gripper goes"])
def test_the_distance_holds_whatever_both_want(rng, robot, person) -> None:
    least = np.inf
    for _ in range(3):
        goal, hand = np.array([-0.18, 0.0, 1.05]), np.array([0.38, rng.uniform(-0.1, 0.1)])
        held, wanted = rng.normal(size=2), np.zeros(3)
        for step in range(300):
            if robot != "still" and step % 8 == 0:
                wanted = rng.normal(0.0, 0.3, 3)
            if robot == "at the hand":
                wanted = 9.0 * np.array([*(hand - goal[:2]), -0.1])
            before, goal = goal, guarded(goal, hand, wanted)
            assert np.linalg.norm(goal - before) <= GOAL_SPEED * TICK_S + 1e-12
            assert ((goal >= GOAL_LOW) & (goal <= GOAL_HIGH)).all()
            if person == "anywhere":
                held = rng.normal(size=2) if step % 10 == 0 else held
            else:
                held = goal[:2] + (10.0 * (goal - before)[:2] if person != "at the gripper" else 0.0) - hand
            length = max(float(np.linalg.norm(held)), 1e-12)
            hand = np.clip(hand + held / length * min(HAND_SPEED * TICK_S, length), LOW, HIGH)
            least = min(least, away(goal, hand))
    assert least >= SEPARATION
    if person == "at the gripper":
        assert least < SEPARATION + 0.05  # they did come as near as that


def test_what_is_safe_is_not_touched() -> None:
    goal, wanted = np.array([-0.1, 0.1, 1.0]), np.array([0.1, -0.05, 0.02])
    np.testing.assert_allclose(guarded(goal, np.array([0.45, -0.4]), wanted), goal + TICK_S * wanted)
    fast = guarded(goal, np.array([0.45, -0.4]), 100.0 * wanted)
    assert np.linalg.norm(fast - goal) == pytest.approx(GOAL_SPEED * TICK_S)


def test_an_arm_without_friction_is_no_farther_off_its_goal_than_the_formula_says(rng) -> None:
    w, dt = np.sqrt(STIFFNESS), 1e-3
    bound, largest = GOAL_SPEED * (2.0 / w + TICK_S), 0.0
    for steady in (True, False):
        x = v = goal = 0.0
        way = 1.0
        for step in range(round(20.0 / dt)):
            if step % round(TICK_S / dt) == 0:
                way = 1.0 if steady else rng.choice([-1.0, 1.0])
                goal += way * GOAL_SPEED * TICK_S
            v += dt * (w**2 * (goal - x) - 2.0 * w * v)
            x += dt * v
            largest = max(largest, abs(goal - x))
    assert 0.8 * bound < largest <= bound
    assert pytest.approx(ALLOWED * bound) == TRACKING
