import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lfd.core.errors import InputError
from lfd.rewards import feature_counts, feature_expectations


@given(st.integers(0, 6), st.sampled_from([0.0, 0.3, 1.0]), st.integers(0, 2**32 - 1))
def test_counts_are_the_discounted_sum(steps: int, discount: float, seed: int) -> None:
    phi = np.random.default_rng(seed).normal(size=(steps, 2))
    expected = sum((discount**t * phi[t] for t in range(steps)), np.zeros(2))
    np.testing.assert_allclose(feature_counts(phi, discount=discount), expected, atol=1e-14)


def test_an_empty_trajectory_counts_nothing_and_discount_0_only_the_first_step() -> None:
    np.testing.assert_array_equal(feature_counts(np.empty((0, 3)), discount=0.9), np.zeros(3))
    np.testing.assert_array_equal(feature_counts(np.array([[1, 2], [3, 4]]), discount=0), [1.0, 2.0])


def test_means_are_over_trajectories_not_steps() -> None:
    phis = [np.ones((1, 1)), np.ones((3, 1)), np.empty((0, 1))]
    result = feature_expectations(phis, discount=1.0)
    np.testing.assert_allclose(result.mean, [4 / 3])
    np.testing.assert_allclose(result.standard_error, [np.std([1, 3, 0], ddof=1) / np.sqrt(3)])
    assert result.trajectories == 3


def test_one_trajectory_has_no_standard_error() -> None:
    assert np.isnan(feature_expectations([np.ones((2, 2))], discount=0.5).standard_error).all()


@pytest.mark.parametrize(
    ("phis", "discount", "message"),
    [
        ([], 0.9, "no trajectory is given"),
        ([np.ones((2, 2)), np.ones((2, 3))], 0.9, r"phi of trajectory 1 has shape \(2, 3\), expected \(T, 2\)"),
        ([np.ones((2, 2)), np.array([[0, 0], [0, np.nan]])], 0.9, r"phi of trajectory 1\[1, 1\] is nan"),
        ([np.ones(2)], 0.9, "phi of trajectory 0 has shape"),
        ([np.ones((2, 2))], 1.1, r"discount = 1.1: give a number in \[0, 1\]"),
        ([np.ones((2, 2))], float("nan"), "discount = nan"),
    ],
)
def test_bad_tables_are_named(phis: list[np.ndarray], discount: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        feature_expectations(phis, discount=discount)
