import time

import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning import grid_world, objectworld
from lfd.planning.grid_worlds import MOVES, grid_transitions
from lfd.reward_learning import maxent_tabular


@pytest.mark.parametrize("slip", [0.0, 0.3, 1.0])
def test_moves_of_a_grid_one_by_one(slip: float) -> None:
    height, width = 2, 3
    chance = grid_transitions(height, width, slip).toarray().reshape(6, 5, 6)
    expected = np.zeros((6, 5, 6))
    for row in range(height):
        for column in range(width):
            for action in range(5):
                for move, (down, right) in enumerate(MOVES):
                    to = row + down, column + right
                    inside = 0 <= to[0] < height and 0 <= to[1] < width
                    target = to[0] * width + to[1] if inside else row * width + column
                    share = (1 - slip) * (move == action) + slip / 5
                    expected[row * width + column, action, target] += share
    np.testing.assert_allclose(chance, expected, atol=1e-15)


def test_a_grid_world_has_the_features_and_reward_of_its_cells() -> None:
    cells = np.arange(12.0).reshape(2, 3, 2)
    start = np.zeros((2, 3))
    start[1, 2] = 1.0
    grid = grid_world(cells, weights=np.array([1.0, -2.0]), slip=0.1, horizon=4, discount=0.9, initial=start)
    np.testing.assert_array_equal(grid.mdp.features[4, 3], cells[1, 1])
    np.testing.assert_array_equal(grid.true_reward[4], cells[1, 1] @ [1.0, -2.0])
    assert grid.mdp.initial[5] == 1.0
    policy = grid.mdp.optimal_solution(np.array([1.0, -2.0])).policy
    value = grid.with_true_reward().feature_expectation(policy)[0]
    assert value == pytest.approx(np.array([1.0, -2.0]) @ grid.mdp.feature_expectation(policy))


def test_without_slip_the_best_path_is_the_shortest() -> None:
    cells = np.zeros((4, 4, 1))
    cells[3, 3] = 1.0
    grid = grid_world(cells, weights=np.ones(1), slip=0.0, horizon=10, discount=1.0)
    values = grid.mdp.optimal_solution(np.ones(1)).values[0].reshape(4, 4)
    steps = np.add.outer(np.arange(3, -1, -1), np.arange(3, -1, -1))
    np.testing.assert_array_equal(values, 10 - steps)


@pytest.mark.parametrize("discrete", [False, True])
def test_objectworld_s_reward_follows_from_its_distances(discrete: bool) -> None:
    options = {"objects": 12, "colours": 3, "slip": 0.3, "horizon": 8, "discount": 0.9}
    world = objectworld(10, **options, discrete=discrete, rng=np.random.default_rng(3))
    distances = objectworld(10, **options, discrete=False, rng=np.random.default_rng(3)).mdp.features[:, 0]
    expected = np.where(distances[:, 0] < 3, np.where(distances[:, 1] < 2, 1, -1), 0)
    np.testing.assert_array_equal(world.true_reward, expected)
    assert {-1, 0, 1} == set(world.true_reward)
    assert (distances.min(axis=0) == 0).all()  # an object of each colour lies somewhere
    if discrete:
        indicators = [distances[:, c] < n for c in range(6) for n in range(1, 11)]
        varying = [each for each in indicators if 0 < each.sum() < 100]
        np.testing.assert_array_equal(world.mdp.features[:, 2], np.transpose(varying))
        assert maxent_tabular(world.mdp, world.mdp.features.mean(axis=(0, 1)), max_iterations=1).iterations == 1
    else:
        assert world.mdp.features.shape == (100, 5, 6)


def test_a_large_grid_is_solved_in_seconds() -> None:
    rng = np.random.default_rng(0)
    started = time.perf_counter()
    grid = grid_world(rng.normal(size=(100, 100, 4)), weights=np.ones(4), slip=0.2, horizon=200, discount=0.99)
    policy = grid.mdp.soft_solution(np.ones(4)).policy
    best = grid.mdp.optimal_solution(np.ones(4))
    assert np.ones(4) @ grid.mdp.feature_expectation(policy) < grid.mdp.initial @ best.values[0]
    assert time.perf_counter() - started < 20.0  # half a second when nothing else runs


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: grid_transitions(2, 2, 1.2), r"slip = 1.2: give a probability in \[0, 1\]"),
        (lambda: grid_transitions(0, 2, 0.1), "a grid of 0 x 2 has no cells"),
        (
            lambda: objectworld(
                2, objects=5, colours=2, slip=0, horizon=1, discount=1, discrete=False, rng=np.random.default_rng(0)
            ),
            "5 objects of 2 colours on 2 x 2 cells",
        ),
    ],
)
def test_impossible_grids_are_refused(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
