import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lfd.core.errors import InputError
from lfd.reward_learning import max_margin

seeds = st.integers(0, 2**32 - 1)


def distance_by_faces(expert: np.ndarray, candidates: np.ndarray) -> float:
    """Distance to the hull as the smallest over all its faces' affine hulls whose nearest point has weights >= 0."""
    best = np.inf
    for size in range(1, min(len(candidates), len(expert) + 1) + 1):
        for face in itertools.combinations(candidates, size):
            corner, sides = face[0], np.reshape(face[1:], (size - 1, len(expert))) - face[0]
            share = np.linalg.lstsq(sides.T, expert - corner, rcond=None)[0] if len(sides) else np.empty(0)
            if (share >= -1e-12).all() and share.sum() <= 1 + 1e-12:
                best = min(best, float(np.linalg.norm(expert - corner - share @ sides)))
    return best


@given(seeds, st.integers(1, 6), st.integers(1, 4))
@settings(max_examples=60)
def test_margin_is_the_distance_to_the_hull(seed: int, count: int, features: int) -> None:
    rng = np.random.default_rng(seed)
    expert, candidates = 2 * rng.normal(size=features), rng.normal(size=(count, features))
    result = max_margin(expert, candidates)
    assert result.margin == pytest.approx(distance_by_faces(expert, candidates), abs=1e-9)
    assert result.mixture.sum() == pytest.approx(1)
    assert (result.mixture >= 0).all()
    assert np.linalg.norm(expert - result.mixture @ candidates) == pytest.approx(result.margin, abs=1e-12)
    # w reaches t for every candidate, which makes it optimal: no w can do better than the distance.
    assert (candidates @ result.weights + result.margin <= expert @ result.weights + 1e-9).all()
    assert np.linalg.norm(result.weights) == pytest.approx(1 if result.margin else 0)


@given(seeds)
@settings(max_examples=30)
def test_translation_and_scale_move_the_margin_as_they_should(seed: int) -> None:
    rng = np.random.default_rng(seed)
    expert, candidates, away = 3 * rng.normal(size=3), rng.normal(size=(5, 3)), rng.normal(size=3)
    result, moved = max_margin(expert, candidates), max_margin(7 * expert + away, 7 * candidates + away)
    assert moved.margin == pytest.approx(7 * result.margin, abs=1e-9)
    if result.margin > 1e-6:
        np.testing.assert_allclose(moved.weights, result.weights, atol=1e-7)


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


@pytest.mark.parametrize(
    ("expert", "what"),
    [([0.3, 0.6], "inside"), ([1.0, 1.0], "a vertex"), ([0.0, 0.4], "an edge"), ([0.5, 0.5], "centre")],
)
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_in_the_hull_weights_and_margin_are_zero(expert: list[float], what: str, scale: float) -> None:
    result = max_margin(scale * np.array(expert), scale * SQUARE)
    assert result.margin == 0
    np.testing.assert_array_equal(result.weights, 0)
    np.testing.assert_allclose(result.mixture @ SQUARE, expert, atol=1e-12)


@given(seeds, st.integers(2, 30), st.integers(1, 10))
@settings(max_examples=40)
def test_any_mixture_of_the_candidates_is_recognised(seed: int, count: int, features: int) -> None:
    rng = np.random.default_rng(seed)
    candidates = rng.normal(size=(count, features))
    assert max_margin(rng.dirichlet(np.ones(count)) @ candidates, candidates).margin == 0


def test_the_nearest_point_of_an_edge_and_of_a_vertex() -> None:
    edge = max_margin(np.array([0.25, 3.0]), SQUARE)
    np.testing.assert_allclose(edge.weights, [0, 1], atol=1e-15)
    np.testing.assert_allclose(edge.mixture, [0, 0, 0.75, 0.25], atol=1e-15)
    vertex = max_margin(np.array([4.0, 5.0]), SQUARE)
    assert vertex.margin == pytest.approx(5)
    np.testing.assert_allclose(vertex.weights, [0.6, 0.8])


def test_a_margin_of_a_billionth_is_seen() -> None:
    result = max_margin(np.array([0.3, 1 + 1e-9]), SQUARE)
    assert result.margin == pytest.approx(1e-9, rel=1e-6)
    np.testing.assert_allclose(result.weights, [0, 1], atol=1e-6)


def test_one_candidate_and_copies_of_it() -> None:
    for count in (1, 5):
        result = max_margin(np.array([3.0, 4.0]), np.zeros((count, 2)))
        assert result.margin == pytest.approx(5)
        np.testing.assert_allclose(result.weights, [0.6, 0.8])
        assert result.mixture.sum() == pytest.approx(1)
    assert max_margin(np.zeros(2), np.zeros((3, 2))).margin == 0


def test_candidates_on_a_line_that_repeat() -> None:
    line = np.array([[0.0, 0], [1, 0], [1, 0], [2, 0], [0.5, 0]])
    assert max_margin(np.array([0.7, 0.0]), line).margin == 0
    assert max_margin(np.array([0.5, 1.0]), line).margin == pytest.approx(1)
    assert max_margin(np.array([3.0, 0.0]), line).margin == pytest.approx(1)


@pytest.mark.parametrize(
    ("expert", "candidates", "message"),
    [
        (np.ones(2), np.empty((0, 2)), "mu_candidates has no row"),
        (np.ones(3), np.ones((1, 2)), r"mu_expert has shape \(3,\), expected \(2,\)"),
        (np.array([1.0, np.nan]), np.ones((1, 2)), r"mu_expert\[1\] is nan"),
        (np.ones(2), np.ones(2), r"mu_candidates has shape \(2,\), expected \(M, K\)"),
    ],
)
def test_what_is_no_problem_is_refused(expert: np.ndarray, candidates: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        max_margin(expert, candidates)
