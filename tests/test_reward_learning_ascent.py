import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lfd.reward_learning.ascent import maximise


@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
@settings(max_examples=30)
def test_the_top_of_a_parabola(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    root, top = rng.normal(size=(size, size)), rng.normal(size=size)
    bend = root @ root.T + 0.1 * np.eye(size)
    found = maximise(
        lambda x: (float(-0.5 * (x - top) @ bend @ (x - top)), bend @ (top - x)),
        np.zeros(size),
        tolerance=1e-10,
        max_iterations=500,
    )
    assert found.converged
    np.testing.assert_allclose(found.point, top, atol=1e-8)


def test_gradients_that_values_cannot_resolve_are_reached() -> None:
    # Beside 1e6 the last 1e-10 of the value are lost: comparing values would stop at a gradient of 1e-5.
    scales = np.array([1.0, 1e2, 1e4])
    found = maximise(
        lambda x: (1e6 - float(np.sum(np.cosh(x - 1) * scales)), -np.sinh(x - 1) * scales),
        np.zeros(3),
        tolerance=1e-11,
        max_iterations=200,
    )
    assert found.converged
    np.testing.assert_allclose(found.point, 1.0, atol=1e-11)


def test_the_domain_is_not_left() -> None:
    def barrier(x: np.ndarray) -> tuple[float, np.ndarray]:
        if x[0] <= 0:
            return -np.inf, np.zeros(1)
        return float(np.log(x[0]) - x[0] / 50), 1 / x - 1 / 50

    found = maximise(barrier, np.array([1e-3]), tolerance=1e-9, max_iterations=100)
    assert found.converged
    assert found.point[0] == pytest.approx(50)


@pytest.mark.filterwarnings("error")
def test_without_a_maximum_it_stops_and_says_so() -> None:
    found = maximise(lambda x: (float(x.sum()), np.ones(2)), np.zeros(2), tolerance=1e-8, max_iterations=1000)
    assert not found.converged
    assert found.iterations < 10
    assert np.isfinite(found.point).all()


def test_iterations_that_run_out_are_reported() -> None:
    found = maximise(
        lambda x: (float(-np.sum(x**4 - x)), 1 - 4 * x**3), np.full(2, 3.0), tolerance=1e-12, max_iterations=2
    )
    assert not found.converged
    assert found.iterations == 2
