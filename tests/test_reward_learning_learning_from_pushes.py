"""Counts are linear in the waypoints here, so that everything has a closed form."""

from typing import Any

import numpy as np
import pytest

from lfd.core.errors import InputError, UnknownName
from lfd.reward_learning.corrections import correction_update
from lfd.reward_learning.learning_from_pushes import PushLearner, slopes
from lfd.reward_learning.weight_belief import WeightBelief
from lfd.rewards.factors import GaussianFactor, PushFactor

RANGES = np.array([2.0, 4.0])
GRADIENTS = np.array([[1.0, 0.0, 0.0], [0.5, 2.0, 0.0]])
"""Of the two counts, by each joint of the sum of the waypoints."""
PLANNED = np.zeros((4, 3))


def counts(trajectories: np.ndarray) -> np.ndarray:
    return trajectories.sum(axis=1) @ GRADIENTS.T


def corrected(*joints: float) -> np.ndarray:
    return PLANNED + np.array(joints) / len(PLANNED)


def learner(rule: str, **others: Any) -> PushLearner:
    return PushLearner(("first", "second"), np.array([-1.0, 0.5]), RANGES, 2.0, rule, **others)


def test_all_is_the_chapters_update_in_units_of_ranges() -> None:
    made = learner("all")
    learned = made.learn(PLANNED, corrected(1.0, -1.0, 0.0), np.ones(3), counts)
    wanted = correction_update(np.array([-1.0, 0.5]), np.array([1.0, -1.5]), np.zeros(2), step_size=2.0 / RANGES**2)
    np.testing.assert_allclose(made.weights, wanted)
    np.testing.assert_allclose(learned.difference, [1.0, -1.5])
    assert made.history == [learned]


def test_one_moves_the_feature_that_changed_most_of_its_range() -> None:
    made = learner("one")
    made.learn(PLANNED, corrected(1.0, -1.0, 0.0), np.ones(3), counts)  # 1 / 2 against 1.5 / 4
    np.testing.assert_allclose(made.weights, [-1.0 + 2.0 / 4.0 * 1.0, 0.5])


def test_a_feature_at_its_bound_was_not_meant() -> None:
    made = learner("one", upper=np.array([-1.0, np.inf]))
    made.learn(PLANNED, corrected(1.0, -1.0, 0.0), np.ones(3), counts)
    np.testing.assert_allclose(made.weights, [-1.0, 0.5 - 2.0 / 16.0 * 1.5])
    low = learner("one", lower=np.array([-np.inf, 0.5]))
    low.learn(PLANNED, corrected(0.1, -1.0, 0.0), np.ones(3), counts)
    np.testing.assert_allclose(low.weights, [-1.0 + 2.0 / 4.0 * 0.1, 0.5])


@pytest.mark.parametrize("rule", ["one", "all", "confident"])
def test_a_bump_teaches_nothing(rule) -> None:
    made = learner(rule)
    learned = made.learn(PLANNED, corrected(0.02, 0.0, 0.0), np.ones(3), counts)
    np.testing.assert_array_equal(made.weights, [-1.0, 0.5])
    assert not learned.difference.any()


def test_slopes_are_the_gradients_for_a_correction_of_even_shape() -> None:
    np.testing.assert_allclose(slopes(PLANNED, corrected(1.0, 1.0, 0.0), counts), 4 * GRADIENTS, rtol=1e-8)


def test_a_push_about_something_without_a_feature_is_not_believed() -> None:
    made, other = learner("confident"), learner("confident")
    change = corrected(1.0, -1.0, 0.0)
    assert made.learn(PLANNED, change, np.array([1.0, -1.0, 0.0]), counts).share == pytest.approx(1.0)
    learned = other.learn(PLANNED, change, np.array([0.0, 1.0, 1.0]), counts)
    assert learned.share == pytest.approx(0.5)
    np.testing.assert_allclose(other.weights - [-1.0, 0.5], 0.5 * (made.weights - [-1.0, 0.5]))


def test_pushes_are_factors_of_one_belief() -> None:
    made = learner("all")
    before = GaussianFactor(made.weights, np.diag(RANGES**2 / 2.0))
    pushes = [
        PushFactor(made.learn(PLANNED, corrected(*joints), np.ones(3), counts).difference)
        for joints in ((1.0, -1.0, 0.0), (0.0, 0.7, 0.2))
    ]
    np.testing.assert_allclose(WeightBelief([before, *pushes]).mode, made.weights)


def test_what_no_learner_can_be_is_refused() -> None:
    with pytest.raises(UnknownName, match="known: all, confident, one"):
        learner("most")
    with pytest.raises(InputError, match="step = 0.0: must be positive"):
        PushLearner(("first", "second"), np.zeros(2), RANGES, 0.0)
