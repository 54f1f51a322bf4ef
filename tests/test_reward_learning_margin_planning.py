import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lfd.core.errors import InputError, LfdError
from lfd.reward_learning import Infeasible, max_margin, max_margin_planning

seeds = st.integers(0, 2**32 - 1)


def problem(seed: int, count: int = 5, features: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=features), rng.normal(size=(count, features)), rng.uniform(0, 2, size=count)


def by_active_sets(better: np.ndarray, margins: np.ndarray, cost: float, nonnegative: bool) -> np.ndarray:
    """(w, v) of 10.6: of all sets of rows that hold with equality, the feasible point of least cost."""
    count, features = better.shape
    rows = np.column_stack([better, np.ones(count)])
    bound = margins
    if nonnegative:
        rows, bound = np.vstack([rows, np.eye(features + 1)[-1]]), np.append(margins, 0.0)
    best, lowest = np.empty(0), np.inf
    quadratic, linear = np.diag([*[2.0] * features, 0.0]), np.append(np.zeros(features), cost)
    for size in range(1, features + 2):
        for active in itertools.combinations(range(len(rows)), size):
            chosen = rows[list(active)]
            system = np.block([[quadratic, -chosen.T], [chosen, np.zeros((size, size))]])
            right = np.concatenate([-linear, bound[list(active)]])
            answer = np.linalg.lstsq(system, right, rcond=None)[0]
            point = answer[: features + 1]
            value = point[:-1] @ point[:-1] + cost * point[-1]
            solves = np.abs(system @ answer - right).max() < 1e-9
            if solves and (rows @ point >= bound - 1e-9).all() and value < lowest:
                best, lowest = point, value
    return best


@given(seeds, st.booleans(), st.sampled_from([0.1, 1.0, 30.0]))
@settings(max_examples=40, deadline=None)
def test_the_slack_form_is_the_best_of_all_active_sets(seed: int, nonnegative: bool, cost: float) -> None:
    expert, candidates, margins = problem(seed)
    result = max_margin_planning(expert, candidates, margins=margins, slack_weight=cost, nonnegative_slack=nonnegative)
    expected = by_active_sets(expert - candidates, margins, cost, nonnegative)
    np.testing.assert_allclose([*result.weights, result.slack], expected, atol=1e-8)


@given(seeds, st.floats(0.01, 100))
@settings(max_examples=30, deadline=None)
def test_one_candidate_has_a_closed_form(seed: int, cost: float) -> None:
    expert, candidates, margins = problem(seed, count=1)
    difference, margin = (expert - candidates)[0], margins[0]
    printed = max_margin_planning(expert, candidates, margins=margins, slack_weight=cost, nonnegative_slack=False)
    np.testing.assert_allclose(printed.weights, cost / 2 * difference, rtol=1e-8)
    assert printed.slack == pytest.approx(margin - cost / 2 * difference @ difference, rel=1e-7, abs=1e-8)
    usual = max_margin_planning(expert, candidates, margins=margins, slack_weight=cost)
    enough = margin / (difference @ difference)
    np.testing.assert_allclose(usual.weights, min(cost / 2, enough) * difference, rtol=1e-7, atol=1e-10)
    assert usual.slack == pytest.approx(max(0.0, margin - cost / 2 * difference @ difference), rel=1e-7, abs=1e-8)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_the_hard_form_with_unit_margins_is_10_5_in_another_scale(seed: int) -> None:
    expert, candidates, _ = problem(seed)
    separation = max_margin(expert, candidates)
    if separation.margin < 1e-3:
        return
    result = max_margin_planning(expert, candidates)
    np.testing.assert_allclose(result.weights, separation.weights / separation.margin, rtol=1e-7, atol=1e-9)
    assert result.slack == 0


def test_printed_weights_grow_with_c_and_others_tend_to_the_hard_form() -> None:
    expert, candidates = np.array([2.0, 1.0]), np.array([[0.0, 0.0], [1.0, 0.5]])
    hard = max_margin_planning(expert, candidates)
    lengths = []
    for cost in (1.0, 10.0, 1e3, 1e5):
        printed = max_margin_planning(expert, candidates, slack_weight=cost, nonnegative_slack=False)
        lengths.append(np.linalg.norm(printed.weights))
        usual = max_margin_planning(expert, candidates, slack_weight=cost)
    assert (np.diff(lengths) > 0).all()
    assert lengths[-1] > 1e4
    assert printed.slack < 0
    np.testing.assert_allclose(usual.weights, hard.weights, atol=1e-8)
    assert usual.slack == pytest.approx(0, abs=1e-8)


def test_given_margins_replace_unit_ones() -> None:
    expert, candidates = np.array([1.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])
    np.testing.assert_allclose(max_margin_planning(expert, candidates).weights, [1, 1], atol=1e-10)
    given_margins = max_margin_planning(expert, candidates, margins=np.array([3.0, 0.5]))
    np.testing.assert_allclose(given_margins.weights, [3, 0.5], atol=1e-10)


def test_copies_of_a_candidate_change_nothing() -> None:
    expert, candidates, margins = problem(3)
    once = max_margin_planning(expert, candidates, margins=margins, slack_weight=2.0)
    often = max_margin_planning(
        expert, np.repeat(candidates, 3, axis=0), margins=np.repeat(margins, 3), slack_weight=2.0
    )
    np.testing.assert_allclose(often.weights, once.weights, atol=1e-9)
    assert often.slack == pytest.approx(once.slack, abs=1e-9)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_the_scale_of_the_features_does_not_matter(scale: float) -> None:
    expert, candidates, margins = problem(5)
    usual = max_margin_planning(expert, candidates, margins=margins, slack_weight=1.0)
    scaled = max_margin_planning(scale * expert, scale * candidates, margins=margins, slack_weight=scale**-2)
    np.testing.assert_allclose(scaled.weights * scale, usual.weights, atol=1e-8)


@pytest.mark.parametrize("expert", [[0.4, 0.5], [1.0, 1.0], [0.0, 0.5]])  # inside, a candidate, on an edge
def test_an_infeasible_hard_form_names_the_form_with_slack(expert: list[float]) -> None:
    candidates = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    with pytest.raises(Infeasible, match=r"convex hull.*Give slack_weight=C for the form with slack \(10.6\)"):
        max_margin_planning(np.array(expert), candidates)
    assert issubclass(Infeasible, LfdError)
    assert max_margin_planning(np.array(expert), candidates, slack_weight=1.0).slack > 0


def test_many_candidates() -> None:
    expert, candidates, margins = problem(0, count=300, features=20)
    result = max_margin_planning(expert, candidates, margins=margins, slack_weight=5.0)
    needed = margins - (expert - candidates) @ result.weights
    assert needed.max() == pytest.approx(result.slack, abs=1e-8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"margins": np.ones(2)}, r"margins has shape \(2,\), expected \(1,\)"),
        ({"margins": np.array([-1.0])}, r"margins\[0\] is negative"),
        ({"slack_weight": 0.0}, "slack_weight = 0.0: the C of 10.6 is positive"),
        ({"slack_weight": -1.0}, "slack_weight = -1.0"),
        ({"nonnegative_slack": False}, "nonnegative_slack=False needs a slack"),
    ],
)
def test_options_that_make_no_sense_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        max_margin_planning(np.ones(2), np.zeros((1, 2)), **changes)
    with pytest.raises(InputError, match="mu_candidates has no row"):
        max_margin_planning(np.ones(2), np.empty((0, 2)))
