import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from lfd.run.wilson import wilson_interval


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_interval_is_scipys(counts: tuple[int, int]) -> None:
    theirs = binomtest(*counts).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson_interval(*counts), (theirs.low, theirs.high), atol=1e-12)


@given(st.integers(1, 500))
def test_the_interval_holds_the_rate_itself_whatever_is_rounded(trials: int) -> None:
    assert wilson_interval(0, trials)[0] == 0.0
    assert wilson_interval(trials, trials)[1] == 1.0


def test_it_solves_its_defining_equation() -> None:
    """Both ends p satisfy |p_hat - p| = z sqrt(p (1 - p) / n)."""
    for end in wilson_interval(45, 50):
        assert abs(0.9 - end) == pytest.approx(1.959963984540054 * np.sqrt(end * (1 - end) / 50))


@pytest.mark.parametrize("counts", [(1, 0), (3, 2), (-1, 2)])
def test_counts_that_cannot_be(counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="successes in"):
        wilson_interval(*counts)
