from itertools import product

import numpy as np
import pytest

from lfd.core.errors import InputError, UnknownName
from lfd.reward_learning.queries import best_batch, best_query, joint_batch, query_values, worth_asking

RATIONALITY = 3.0


def bradley_terry(w: np.ndarray, d: np.ndarray) -> float:
    return float(1.0 / (1.0 + np.exp(-RATIONALITY * (w @ d))))


def entropy(chances) -> float:
    return float(-sum(p * np.log2(p) for p in chances if p > 0.0))


@pytest.fixture
def drawn(rng):
    samples = rng.normal(size=(30, 3))
    return rng.normal(size=(8, 3)), samples / np.linalg.norm(samples, axis=1, keepdims=True)


def test_information_gain_is_mutual_information_by_enumeration(drawn) -> None:
    differences, samples = drawn
    values = query_values(differences, samples, criterion="information_gain", rationality=RATIONALITY)
    for d, value in zip(differences, values, strict=True):
        joint = np.array([[p / len(samples), (1.0 - p) / len(samples)] for p in (bradley_terry(w, d) for w in samples)])
        expected = entropy(joint.sum(axis=0)) + entropy(joint.sum(axis=1)) - entropy(joint.ravel())
        assert value == pytest.approx(expected, abs=1e-12)


def test_the_volumes_are_their_formulas(drawn) -> None:
    differences, samples = drawn
    removed = query_values(differences, samples, criterion="volume_removal", rationality=RATIONALITY)
    volume = query_values(differences, samples, criterion="expected_volume", rationality=RATIONALITY)
    for number, d in enumerate(differences):
        f = [min(1.0, np.exp(RATIONALITY * (w @ d))) for w in samples]
        other = [min(1.0, np.exp(-RATIONALITY * (w @ d))) for w in samples]
        assert removed[number] == pytest.approx(min(1.0 - np.mean(f), 1.0 - np.mean(other)), abs=1e-12)
        pbar = np.mean([bradley_terry(w, d) for w in samples])
        assert volume[number] == pytest.approx(1.0 - pbar**2 - (1.0 - pbar) ** 2, abs=1e-12)


def test_certain_answers_have_no_noise_and_huge_returns_no_overflow() -> None:
    samples = np.array([[1.0, 0.0], [-1.0, 0.0]])
    differences = np.array([[1e6, 0.0], [0.0, 1e6]])
    gain = query_values(differences, samples, criterion="information_gain", rationality=1.0)
    np.testing.assert_allclose(gain, [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("criterion", ["information_gain", "volume_removal", "expected_volume"])
def test_the_best_query_is_the_best_of_all_pairs_and_never_of_two_identical(criterion, rng, drawn) -> None:
    _, samples = drawn
    features = np.concatenate([rng.normal(size=(6, 3)), np.zeros((2, 3)) + 0.3])
    pairs = [(i, j) for i in range(8) for j in range(i + 1, 8) if (features[i] != features[j]).any()]
    differences = np.array([features[i] - features[j] for i, j in pairs])
    values = query_values(differences, samples, criterion=criterion, rationality=RATIONALITY)
    i, j, value = best_query(features, samples, criterion=criterion, rationality=RATIONALITY)
    assert (i, j) == pairs[int(values.argmax())]
    assert value == pytest.approx(values.max(), abs=1e-12)


def test_a_batch_is_the_greedy_one_by_joint_enumeration(drawn, rng) -> None:
    _, samples = drawn
    features = rng.normal(size=(5, 3))
    pairs = [(i, j) for i in range(5) for j in range(i + 1, 5)]
    chances = {p: np.array([bradley_terry(w, features[p[0]] - features[p[1]]) for w in samples]) for p in pairs}

    def told(chosen) -> float:
        answers = [
            np.prod([chances[p] if a else 1.0 - chances[p] for p, a in zip(chosen, said, strict=True)], axis=0)
            for said in product([0, 1], repeat=len(chosen))
        ]
        noise = np.mean([entropy([answer[m] for answer in answers]) for m in range(len(samples))])
        return entropy([answer.mean() for answer in answers]) - float(noise)

    chosen: list[tuple[int, int]] = []
    batch = best_batch(features, samples, 3, rationality=RATIONALITY)
    for query in batch:
        gains = {p: told([*chosen, p]) - (told(chosen) if chosen else 0.0) for p in pairs}
        best = max(gains, key=lambda p: gains[p])
        assert (query.i, query.j) == best
        assert query.value == pytest.approx(gains[best], abs=1e-10)
        chosen.append(best)
    assert len(set(chosen)) == 3


def test_a_question_that_tells_less_than_it_costs_is_not_asked(drawn) -> None:
    features, samples = drawn
    query = best_query(features, samples, rationality=RATIONALITY)
    assert worth_asking(query, query.value / 2)
    assert not worth_asking(query, query.value)


def test_what_cannot_be_asked_is_said(drawn) -> None:
    differences, samples = drawn
    with pytest.raises(InputError, match="all trajectories have the same features"):
        best_query(np.ones((3, 3)), samples, rationality=1.0)
    with pytest.raises(InputError, match=r"samples has shape \(30, 3\), expected \(M, 2\)"):
        query_values(differences[:, :2], samples, rationality=1.0)
    with pytest.raises(InputError, match="rationality = 0"):
        query_values(differences, samples, rationality=0.0)
    with pytest.raises(UnknownName, match="information_gain"):
        query_values(differences, samples, criterion="entropy", rationality=1.0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="samples is empty"):
        query_values(differences, samples[:0], rationality=1.0)


def test_a_batch_of_given_differences_asks_nothing_twice_and_is_that_of_all_pairs(rng, drawn) -> None:
    _, samples = drawn
    features = rng.normal(size=(4, 3))
    pairs = np.array([(i, j) for i in range(4) for j in range(i + 1, 4)])
    chosen = joint_batch(features[pairs[:, 0]] - features[pairs[:, 1]], samples, 8, rationality=RATIONALITY)
    assert sorted(q for q, _ in chosen) == list(range(6))
    batch = best_batch(features, samples, 6, rationality=RATIONALITY)
    assert [(i, j) for i, j, _ in batch] == [tuple(pairs[q]) for q, _ in chosen]
    np.testing.assert_allclose([q.value for q in batch], [bits for _, bits in chosen])
    with pytest.raises(InputError, match="all trajectories have the same features"):
        best_batch(np.ones((3, 3)), samples, 2, rationality=RATIONALITY)


def test_the_gains_of_a_batch_stay_numbers_where_answers_are_certain(rng) -> None:
    """Chances of 1 under every sample: p(b) is 0 but for rounding, which may have either sign."""
    for count in range(20, 60):
        samples = np.column_stack([rng.normal(size=count), np.ones(count)])
        differences = np.array([[1.0, 0.0], [0.5, 0.1], [0.0, 1e6], [0.0, 2e6]])
        gains = np.array([bits for _, bits in joint_batch(differences, samples, 4, rationality=1.0)])
        assert np.isfinite(gains).all()
        assert (gains > -1e-12).all()
