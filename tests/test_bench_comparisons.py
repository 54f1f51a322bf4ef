import numpy as np
import pytest

from lfd.bench.comparisons import INFORMATION, RANDOM, ComparisonsBench, bench_comparisons, plot, questions_to, rows_of


def test_the_goal_counts_from_where_it_is_kept() -> None:
    curves = np.array([[0.2, 0.96, 0.9, 0.97, 0.99], [0.96, 0.97, 0.98, 0.99, 0.99], [0.1, 0.2, 0.3, 0.4, 0.5]])
    np.testing.assert_array_equal(questions_to(curves, 0.95), [4.0, 1.0, np.inf])


@pytest.mark.slow
def test_chosen_questions_teach_more_than_random_ones_and_are_drawn(tmp_path) -> None:
    measured = bench_comparisons(features=(3,), people=3, questions=10, seed=0)
    rows = rows_of(measured)
    curves = measured.alignment["3 features, no mistakes"]
    assert curves[INFORMATION][:, -1].mean() > curves[RANDOM][:, -1].mean()
    assert curves[INFORMATION][:, -1].mean() > 0.95
    assert "information gain" in rows["3 features, noisy: questions to alignment 0.95, median [quartiles]"]
    plot(measured, tmp_path / "comparisons.png")
    assert (tmp_path / "comparisons.png").stat().st_size > 0


def test_never_is_said() -> None:
    measured = ComparisonsBench(people=2, questions=2, alignment={"case": {RANDOM: np.full((2, 2), 0.1)}})
    assert rows_of(measured)["case: questions to alignment 0.95, median [quartiles]"] == "random never [never, never]"
