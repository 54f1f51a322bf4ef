import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from lfd.core.errors import InputError
from lfd.reward_learning.corrections import correction_update, explained_share, one_feature_update

W, HUMAN, ROBOT = np.array([0.5, -1.0, 0.2]), np.array([1.0, 0.3, 0.0]), np.array([0.6, 0.8, 0.4])


def test_the_update_is_the_chapters() -> None:
    np.testing.assert_allclose(correction_update(W, HUMAN, ROBOT, step_size=0.5), [0.7, -1.25, 0.0])


@pytest.mark.parametrize("bounds", [None, (-0.9, 0.6)])
@pytest.mark.parametrize("beta", [0.5, np.array([0.1, 0.5, 2.0])])
def test_the_update_maximises_the_posterior(beta, bounds) -> None:
    def less(w):
        return -(w @ (HUMAN - ROBOT) - ((w - W) ** 2 / (2.0 * beta)).sum())

    low, high = bounds or (None, None)
    best = minimize(less, np.zeros(3), bounds=[(low, high)] * 3, options={"ftol": 1e-15, "gtol": 1e-10}).x
    np.testing.assert_allclose(
        correction_update(W, HUMAN, ROBOT, step_size=beta, lower=low, upper=high), best, atol=1e-6
    )


@given(st.floats(0.01, 10.0), st.integers(0, 2**32 - 1))
def test_a_correction_raises_the_reward_of_what_was_shown_over_what_was_planned(beta, seed) -> None:
    w, human, robot = np.random.default_rng(seed).normal(size=(3, 4))
    after = correction_update(w, human, robot, step_size=beta)
    assert (after - w) @ (human - robot) > 0.0


def test_one_feature_is_the_one_that_changed_most_of_its_range() -> None:
    w, k = one_feature_update(W, HUMAN, ROBOT, step_size=0.5, ranges=np.array([1.0, 1.0, 0.5]))
    assert k == 2
    np.testing.assert_allclose(w, [0.5, -1.0, 0.0])
    assert one_feature_update(W, HUMAN, ROBOT, step_size=0.5, ranges=np.ones(3))[1] == 1
    np.testing.assert_array_equal(W, [0.5, -1.0, 0.2])


def test_a_push_is_explained_as_far_as_it_lies_in_the_span_of_the_gradients() -> None:
    gradients = np.array([[1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]])
    assert explained_share(np.array([3.0, -2.0, 0.0, 0.0]), gradients) == pytest.approx(1.0)
    assert explained_share(np.array([0.0, 0.0, 1.0, -1.0]), gradients) == pytest.approx(0.0)
    assert explained_share(np.array([1.0, 0.0, 1.0, 0.0]), gradients) == pytest.approx(0.5)
    assert explained_share(np.array([1.0, 0.0, 1.0, 0.0]), np.vstack([gradients, gradients])) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"f_corrected": HUMAN[:2]}, r"f_corrected has shape \(2,\), expected \(3,\)"),
        ({"f_planned": np.array([0.0, np.nan, 0.0])}, r"f_planned\[1\] is nan"),
        ({"step_size": 0.0}, "step_size = 0.0: must be positive"),
        ({"step_size": np.ones(2)}, "one for each of the 3 weights"),
        ({"lower": 1.0, "upper": np.array([2.0, 0.0, 3.0])}, r"lower\[1\] = 1.0 is above upper\[1\] = 0.0"),
    ],
)
def test_what_does_not_fit_is_said(change, message) -> None:
    given_ = {"f_corrected": HUMAN, "f_planned": ROBOT, "step_size": 0.1} | change
    corrected, planned = given_.pop("f_corrected"), given_.pop("f_planned")
    with pytest.raises(InputError, match=message):
        correction_update(W, corrected, planned, **given_)


def test_ranges_must_be_positive() -> None:
    with pytest.raises(InputError, match=r"ranges\[1\] = 0.0"):
        one_feature_update(W, HUMAN, ROBOT, step_size=0.1, ranges=np.array([1.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="nothing was corrected"):
        explained_share(np.zeros(2), np.eye(2))
