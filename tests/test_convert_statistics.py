import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lfd.convert.dataset.statistics import (
    QUANTILES,
    SAMPLED_PICTURES,
    SAMPLED_SIDE,
    aggregate,
    column_stats,
    picture_stats,
    sampled_rows,
)

EXACT = ("min", "max", "mean", "std", "count")


def by_numpy(rows: np.ndarray) -> dict[str, np.ndarray]:
    found = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    return found | {name: np.quantile(rows, q, axis=0) for name, q in QUANTILES.items()}


@pytest.mark.parametrize("length", [1, 2, 3, 100, 101, 997])
def test_the_columns_statistics_are_those_of_numpy(length, rng) -> None:
    columns = {
        "a": rng.normal(5, 3, (length, 4)).astype(np.float32),
        "flag": rng.random((length, 1)) < 0.3,
        "index": np.arange(length)[:, None] + 2**40,
    }
    found = column_stats(columns)
    assert list(found) == list(columns)
    for name, rows in columns.items():
        expected = by_numpy(rows.astype(np.float64))
        assert set(found[name]) == {*expected, "count"}
        for key, value in expected.items():
            np.testing.assert_allclose(found[name][key], value, rtol=1e-12, atol=1e-12, err_msg=f"{name} {key}")
        assert found[name]["count"].tolist() == [length]


def test_the_pictures_statistics_are_those_of_numpy(rng) -> None:
    pictures = [rng.integers(0, 256, (20, 30, 3), dtype=np.uint8) for _ in range(7)]
    found = picture_stats(pictures)
    expected = by_numpy(np.stack(pictures).reshape(-1, 3) / 255)
    for key, value in expected.items():
        assert found[key].shape == (3, 1, 1)
        np.testing.assert_allclose(found[key][:, 0, 0], value, rtol=1e-12, err_msg=key)
    assert found["count"].tolist() == [7]


def test_large_pictures_are_thinned_and_many_are_sampled(rng) -> None:
    large = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    step = 640 // SAMPLED_SIDE
    expected = large[::step, ::step].reshape(-1, 3) / 255
    np.testing.assert_allclose(picture_stats([large])["mean"][:, 0, 0], expected.mean(axis=0))
    below = rng.integers(0, 256, (20, 2 * SAMPLED_SIDE - 1, 3), dtype=np.uint8)
    np.testing.assert_allclose(picture_stats([below])["std"][:, 0, 0], (below.reshape(-1, 3) / 255).std(axis=0))
    assert sampled_rows(7) == list(range(7))
    rows = sampled_rows(12_345)
    assert (rows[0], rows[-1], len(set(rows))) == (0, 12_344, SAMPLED_PICTURES)


numbers = st.floats(-1e6, 1e6, width=32)


@settings(deadline=None)
@given(
    st.lists(arrays(np.float32, st.tuples(st.integers(1, 12), st.just(2)), elements=numbers), min_size=1, max_size=6)
)
def test_the_aggregate_is_the_statistics_of_all_rows(parts: list[np.ndarray]) -> None:
    together = aggregate([column_stats({"a": rows}) for rows in parts])["a"]
    whole = column_stats({"a": np.concatenate(parts)})["a"]
    size = float(np.abs(np.concatenate(parts)).max())
    for key in EXACT:
        # the variance is a difference of squares, so its root is right to the root of the precision
        np.testing.assert_allclose(together[key], whole[key], rtol=1e-9, atol=1e-7 * size, err_msg=key)
    for name in QUANTILES:  # by definition: the means of the parts' quantiles, weighted by their lengths
        expected = sum(len(rows) * np.quantile(rows.astype(float), QUANTILES[name], axis=0) for rows in parts)
        np.testing.assert_allclose(together[name], expected / sum(map(len, parts)), rtol=1e-9, atol=1e-9 * size)


def test_the_aggregate_does_not_depend_on_how_it_is_grouped(rng) -> None:
    parts = [column_stats({"a": rng.normal(size=(n, 3))}) for n in (3, 50, 8, 21)]
    at_once, in_turn = aggregate(parts)["a"], aggregate([aggregate(parts[:2]), *parts[2:]])["a"]
    for key, value in at_once.items():
        np.testing.assert_allclose(in_turn[key], value, rtol=1e-12, err_msg=key)
    assert in_turn["count"].tolist() == [82]


@pytest.mark.slow
def test_lerobot_computes_the_same_within_its_histograms(rng) -> None:
    """Its quantiles come from 5000 bins between minimum and maximum, ours are exact."""
    from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats

    parts, theirs = [], []
    for length in (400, 900):
        rows = rng.normal(2, 1, (length, 3)).astype(np.float32)
        pictures = rng.integers(0, 256, (12, 40, 30, 3), dtype=np.uint8)
        ours = column_stats({"a": rows}) | {"observation.images.a": picture_stats(list(pictures))}
        stats = get_feature_stats(pictures.transpose(0, 3, 1, 2), axis=(0, 2, 3), keepdims=True)
        scaled = {k: v if k == "count" else np.squeeze(v / 255, axis=0) for k, v in stats.items()}
        parts.append(ours)
        theirs.append({"a": get_feature_stats(rows, axis=0, keepdims=False), "observation.images.a": scaled})
        for name in ours:
            assert set(ours[name]) == set(theirs[-1][name])
            spread = ours[name]["max"] - ours[name]["min"]
            for key, value in theirs[-1][name].items():
                assert ours[name][key].shape == value.shape
                # between two sorted rows of 400, a quantile may lie anywhere
                allowed = spread * (0.02 if key in QUANTILES else 1e-5)
                assert (np.abs(ours[name][key] - value) <= allowed).all(), (name, key)
    expected = aggregate_stats(parts)
    for name, stats in aggregate(parts).items():
        for key, value in stats.items():
            np.testing.assert_allclose(value, expected[name][key], rtol=1e-12, err_msg=f"{name} {key}")
            assert value.shape == expected[name][key].shape
