"""Resampling by closed forms: what is between samples, and when there is nothing to stand there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lfd.convert.foreign.resample import hold, linear, longest_interval, nearest, rows_between, slerp

STEPS = st.lists(st.integers(2_000, 400_000), min_size=1, max_size=30)
"""Microseconds between samples; further apart than what counts as the same instant."""


def times_from(steps: list[int]) -> np.ndarray:
    return np.cumsum([0, *steps]) / 1e6


def rows_for(times: np.ndarray, count: int) -> np.ndarray:
    return np.linspace(times[0], times[-1], count)


@given(STEPS, st.integers(2, 50), st.floats(-3, 3), st.floats(-3, 3))
def test_linear_reproduces_an_affine_signal(steps: list[int], count: int, a: float, b: float) -> None:
    times = times_from(steps)
    rows = rows_for(times, count)
    values, valid = linear(times, np.stack([a + b * times, b - a * times], axis=1), rows, 1.0)
    assert valid.all()
    np.testing.assert_allclose(values, np.stack([a + b * rows, b - a * rows], axis=1), atol=1e-12 * (1 + times[-1]))


@given(STEPS, st.integers(2, 50), st.floats(-7, 7), st.lists(st.booleans(), min_size=31, max_size=31))
def test_slerp_is_constant_angular_velocity(steps: list[int], count: int, speed: float, flips: list[bool]) -> None:
    """Also when samples come with either sign: q and -q are the same rotation."""
    times = times_from(steps)
    rows = rows_for(times, count)

    def about_axis(t: np.ndarray) -> np.ndarray:
        axis = np.array([2.0, -1.0, 2.0]) / 3.0
        half = 0.5 * speed * t[:, None]
        return np.concatenate([np.cos(half), np.sin(half) * axis], axis=1)

    signs = np.where(flips[: len(times)], -1.0, 1.0)[:, None]
    turned, valid = slerp(times, signs * about_axis(times), rows, 1.0)
    assert valid.all()
    alike = np.abs(np.einsum("td,td->t", turned, about_axis(rows)))
    np.testing.assert_allclose(alike, 1.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0, atol=1e-12)
    if count > 20 and abs(speed) * times[-1] < count:
        assert (np.einsum("td,td->t", turned[1:], turned[:-1]) > 0).all()  # no jump of sign


def test_slerp_of_equal_and_nearly_equal_samples() -> None:
    q = np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0], [1.0, 1e-12, 0, 0]])
    turned, valid = slerp(np.array([0.0, 1.0, 2.0]), q, np.array([0.5, 1.5]), 2.0)
    assert valid.all()
    np.testing.assert_allclose(turned[:, 0], 1.0)


@given(STEPS, st.integers(2, 50), st.floats(0.001, 0.5))
def test_hold_and_nearest_by_brute_force(steps: list[int], count: int, gap: float) -> None:
    times = times_from(steps)
    rows = rows_for(times, count)
    index, valid = hold(times, rows, gap)
    near, near_valid = nearest(times, rows, gap)
    for t, i, good, j, near_good in zip(rows, index, valid, near, near_valid, strict=True):
        assert i == max(k for k, time in enumerate(times) if time <= t + 1e-6)
        assert good == (t - times[i] <= gap + 1e-6)
        assert abs(times[j] - t) == np.abs(times - t).min()
        assert near_good == (np.abs(times - t).min() <= gap / 2 + 1e-6)


@given(STEPS, st.integers(2, 60), st.floats(0.01, 0.5))
def test_nothing_is_filled_in_a_longer_gap(steps: list[int], count: int, gap: float) -> None:
    """Away from samples, linear and slerp are valid exactly where the samples around are close enough."""
    times = times_from(steps)
    rows = rows_for(times, count)
    _, line = linear(times, times[:, None], rows, gap)
    _, arc = slerp(times, np.tile([1.0, 0, 0, 0], (len(times), 1)), rows, gap)
    assert (line == arc).all()
    for t, good in zip(rows, line, strict=True):
        if np.abs(times - t).min() <= 1e-6:
            assert good
        else:
            after = np.searchsorted(times, t)
            assert good == (times[after] - times[after - 1] <= gap + 1e-6)


def test_a_row_at_a_sample_is_valid_beside_a_gap() -> None:
    times, rows = np.array([0.0, 0.1, 5.0]), np.array([0.0, 0.1, 0.2, 4.9, 5.0])
    for valid in (
        linear(times, times[:, None], rows, 0.1)[1],
        hold(times, rows, 0.05)[1],
        nearest(times, rows, 0.1)[1],
    ):
        assert valid.tolist() == [True, True, False, False, True]


def test_rows_before_the_first_sample_are_invalid() -> None:
    times, rows = np.array([0.5, 0.6]), np.array([0.0, 0.55, 0.7])
    assert hold(times, rows, 1.0)[1].tolist() == [False, True, True]
    assert linear(times, times[:, None], rows, 1.0)[1].tolist() == [False, True, False]


def test_a_single_sample_serves_its_own_instant() -> None:
    times, rows = np.array([0.0]), np.array([0.0, 0.5])
    assert linear(times, np.array([[3.0]]), rows, 10.0)[0].tolist() == [[3.0], [3.0]]
    assert linear(times, np.array([[3.0]]), rows, 10.0)[1].tolist() == [True, False]


@pytest.mark.parametrize("fps", [30, 60, 7, 20])
def test_stamps_rounded_to_nanoseconds_stand_at_their_rows(fps: int) -> None:
    """A source at the rate of the rows gives each its own sample, however its stamps were rounded."""
    start = 1_757_502_238_482_648_699
    for rounding in (np.floor, np.ceil, np.round):
        stamps = start + rounding(np.arange(300) * 1e9 / fps).astype(np.int64)
        rows = rows_between(start, int(stamps[-1]), fps)
        index, valid = hold((stamps - start) / 1e9, rows, 0.5 / fps)
        assert valid.all()
        assert index.tolist() == list(range(300))


def test_rows_end_with_the_channel() -> None:
    assert rows_between(0, 10**9, 10).tolist() == [k / 10 for k in range(11)]
    assert rows_between(0, 10**9 - 2000, 10).tolist() == [k / 10 for k in range(10)]
    assert rows_between(10, 10, 10).tolist() == [0.0]


def test_longest_interval() -> None:
    assert longest_interval(np.array([0.0, 0.1, 0.5, 0.6])) == (1, 0.4)
    assert longest_interval(np.array([2.0])) == (0, 0.0)
