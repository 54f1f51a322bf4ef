from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy.optimize import minimize

from lfd.core.errors import InputError
from lfd.reward_learning.choices import log_likelihood
from lfd.reward_learning.corrections import correction_update
from lfd.reward_learning.weight_belief import WeightBelief, belief_of, undone, updated, weights_about
from lfd.rewards.factors import Choice, ChoiceFactor, GaussianFactor, PushFactor
from lfd.rewards.reward_artifact import LinearReward

GAUSSIAN = GaussianFactor(np.array([0.5, -1.0]), np.array([[0.3, 0.1], [0.1, 0.2]]))
PUSH = PushFactor(np.array([0.4, -0.2]))
CHOICES = (
    ChoiceFactor(np.array([1.0, 0.3]), 0.4, "a", 2.0),
    ChoiceFactor(np.array([-0.4, 1.5]), -0.6, "b", 3.0),
    ChoiceFactor(np.array([0.8, -0.8]), 0.1, "equal", 5.0),
    ChoiceFactor(np.array([1.2, 0.4]), -0.2, "a", 4.0),
)
ALL = (GAUSSIAN, PUSH, *CHOICES)


def answered(w: np.ndarray, one: ChoiceFactor) -> np.ndarray:
    """log p of an answer for (M, 2) weights."""
    choice: Choice = "a" if one.choice == "a" else "b" if one.choice == "b" else "equal"
    return log_likelihood("bradley_terry", one.rationality * (w @ one.difference + one.offset), choice)


def by_hand(w: np.ndarray) -> np.ndarray:
    """log p of (M, 2) weights, factor by factor."""
    away = w - GAUSSIAN.mean
    total = -0.5 * np.einsum("mk,kj,mj->m", away, GAUSSIAN.precision, away) + w @ PUSH.difference
    for one in CHOICES:
        total = total + answered(w, one)
    return total


def grid(belief: WeightBelief, count: int = 801) -> tuple[np.ndarray, np.ndarray]:
    """Weights in a box of 10 standard deviations about the mode, and p of each by hand."""
    spread = np.sqrt(np.diag(belief.covariance))
    axes = [np.linspace(m - 10 * s, m + 10 * s, count) for m, s in zip(belief.mode, spread, strict=True)]
    w = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    height = by_hand(w)
    p = np.exp(height - height.max())
    return w, p / p.sum()


def test_the_density_is_the_product_of_its_factors(rng: np.random.Generator) -> None:
    w = rng.normal(0.0, 2.0, (50, 2))
    away = WeightBelief(ALL).log_density(w) - by_hand(w)
    np.testing.assert_allclose(away, away[0], atol=1e-12)


def test_the_mode_is_that_of_a_grid_and_of_scipy() -> None:
    belief = WeightBelief(ALL)
    w, p = grid(belief)
    spread = np.sqrt(np.diag(belief.covariance))
    assert (np.abs(w[p.argmax()] - belief.mode) <= 20 * spread / 800).all()
    found = minimize(lambda x: -by_hand(x[None])[0], np.zeros(2), tol=1e-12)
    np.testing.assert_allclose(belief.mode, found.x, atol=1e-6)


def test_the_covariance_is_the_inverse_curvature_of_the_density() -> None:
    belief, h = WeightBelief(ALL), 1e-4
    offsets = h * np.eye(2)

    def second(i: int, j: int) -> float:
        at = [belief.mode + si * offsets[i] + sj * offsets[j] for si in (1, -1) for sj in (1, -1)]
        values = by_hand(np.array(at))
        return float(values[0] - values[1] - values[2] + values[3]) / (4 * h * h)

    curvature = -np.array([[second(i, j) for j in range(2)] for i in range(2)])
    np.testing.assert_allclose(belief.covariance, np.linalg.inv(curvature), rtol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_samples_have_the_moments_and_the_quantiles_of_a_grid(scale: float, rng: np.random.Generator) -> None:
    """Also where the Gaussian is a thousand times as wide as what the answers leave, in one direction only."""
    wide = replace(GAUSSIAN, precision=scale**2 * GAUSSIAN.precision)
    belief = WeightBelief([wide, PushFactor(np.zeros(2)), *CHOICES])
    angle, radius = np.linspace(-np.pi, np.pi, 1441)[:-1], np.geomspace(1e-3, 60 / scale, 1500)
    w = belief.mode + radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    height = belief.log_density(w.reshape(-1, 2))
    p = np.exp(height - height.max()) * np.repeat(radius**2, len(angle))  # r dr = r^2 d log r
    p, w = p / p.sum(), w.reshape(-1, 2)
    drawn = belief.sample(20_000, rng)
    for k in range(2):
        order = np.argsort(w[:, k])
        for share in (0.05, 0.25, 0.5, 0.75, 0.95):
            place = w[order, k][np.searchsorted(np.cumsum(p[order]), share)]
            assert (drawn[:, k] < place).mean() == pytest.approx(share, abs=0.015)


def test_without_choices_it_is_normal_and_samples_are_exact(rng: np.random.Generator) -> None:
    belief = WeightBelief([GAUSSIAN, PUSH])
    np.testing.assert_allclose(belief.covariance, np.linalg.inv(GAUSSIAN.precision), rtol=1e-12)
    drawn = belief.sample(100_000, rng)
    np.testing.assert_allclose(drawn.mean(axis=0), belief.mode, atol=0.03)
    np.testing.assert_allclose(np.cov(drawn.T), belief.covariance, rtol=0.03, atol=0.05)
    assert belief.consistency == 1.0


def test_a_push_is_the_correction_update(rng: np.random.Generator) -> None:
    weights, beta, pushed, planned = (
        rng.normal(size=3),
        rng.uniform(0.1, 5.0, 3),
        rng.normal(size=3),
        rng.normal(size=3),
    )
    belief = WeightBelief([GaussianFactor(weights, np.diag(1 / beta)), PushFactor(pushed - planned)])
    expected = correction_update(weights, pushed, planned, step_size=beta)
    np.testing.assert_allclose(belief.mode, expected, rtol=1e-12)
    np.testing.assert_allclose(belief.covariance, np.diag(beta), rtol=1e-12)


def test_the_order_of_the_evidence_does_not_matter() -> None:
    first = WeightBelief(ALL)
    for factors in list(permutations(ALL))[::60]:
        belief = WeightBelief(factors)
        np.testing.assert_allclose(belief.mode, first.mode, atol=1e-9)
        np.testing.assert_allclose(belief.covariance, first.covariance, atol=1e-12)


def test_consistency_is_the_mean_chance_of_the_answers(rng: np.random.Generator) -> None:
    belief = WeightBelief(ALL)
    w = belief.mode + rng.multivariate_normal(np.zeros(2), belief.covariance, 200_000)
    chances = [np.exp(answered(w, one)).mean() for one in CHOICES]
    assert belief.consistency == pytest.approx(np.mean(chances), abs=1e-3)


def test_answers_that_contradict_each_other_lower_the_consistency() -> None:
    def after(answers: str) -> WeightBelief:
        return WeightBelief([GAUSSIAN, *(ChoiceFactor(np.array([1.0, 0.0]), 0.0, c, 4.0) for c in answers)])

    steady, torn = after("aaaaaa"), after("ababab")
    assert steady.consistency > 0.8
    assert torn.consistency < 0.55
    assert abs(torn.mode[0]) < 0.1


def test_it_is_found_in_any_units() -> None:
    """Features in other units: weights in the inverse units, and nothing else changes."""
    units = np.array([1e6, 1e-5])
    scaled = WeightBelief([
        GaussianFactor(GAUSSIAN.mean / units, GAUSSIAN.precision * np.outer(units, units)),
        PushFactor(PUSH.difference * units),
        *(replace(f, difference=f.difference * units) for f in CHOICES),
    ])  # fmt: skip
    plain = WeightBelief(ALL)
    np.testing.assert_allclose(scaled.mode * units, plain.mode, rtol=1e-8)
    np.testing.assert_allclose(scaled.covariance * np.outer(units, units), plain.covariance, rtol=1e-8)


def test_the_mode_is_found_where_answers_are_many_and_a_person_is_sure(rng: np.random.Generator) -> None:
    truth = rng.normal(size=6)
    differences = rng.normal(size=(300, 6))
    answers = ["a" if d @ truth > 0 else "b" for d in differences]
    for rationality in (1e-3, 1.0, 1e3):
        choices = [ChoiceFactor(d, 0.0, a, rationality) for d, a in zip(differences, answers, strict=True)]
        belief = WeightBelief([GaussianFactor(np.zeros(6), 1e-4 * np.eye(6)), *choices])
        assert belief.mode @ truth / np.linalg.norm(belief.mode) / np.linalg.norm(truth) > 0.97
        assert np.linalg.eigvalsh(belief.covariance).min() > 0


def test_a_belief_without_end_is_refused() -> None:
    with pytest.raises(InputError, match="no Gaussian factor, so that it has no end: begin with demonstrations"):
        WeightBelief([PUSH, *CHOICES])
    with pytest.raises(InputError, match="say nothing about some direction of the weights"):
        WeightBelief([GaussianFactor(np.zeros(2), np.diag([1.0, 0.0]))])
    with pytest.raises(InputError, match="factor 1 has 3 numbers, expected 2"):
        WeightBelief([GAUSSIAN, PushFactor(np.zeros(3))])
    with pytest.raises(InputError, match="n = 0: ask for at least 1 sample"):
        WeightBelief([GAUSSIAN]).sample(0, np.random.default_rng(0))


REWARD = LinearReward(
    features=("person_closeness", "cup_tilt"),
    weights=np.array([-3.0, 0.0]),
    ranges=np.array([2.0, 0.5]),
    robot="panda",
    waypoints=20,
    duration_s=40.0,
    smoothness=80.0,
    method="margin",
)


def test_weights_without_a_spread_are_right_to_half_their_size() -> None:
    factor = weights_about(REWARD.weights, REWARD.ranges)
    per_range = np.diag(factor.precision) ** -0.5 * REWARD.ranges
    np.testing.assert_allclose(per_range, [(6 + 6 / np.sqrt(2)) / 2, 6 / np.sqrt(2) / 2])
    nothing = weights_about(np.zeros(2), REWARD.ranges)
    np.testing.assert_allclose(np.diag(nothing.precision) ** -0.5, 1 / REWARD.ranges)


def test_one_reward_takes_any_evidence_in_any_order_and_gives_it_back() -> None:
    evidence = [(GAUSSIAN, "demonstrations"), (PUSH, "a push"), *((c, "an answer") for c in CHOICES)]
    ends = []
    for order in (evidence, evidence[::-1]):
        reward = REWARD
        for factor, words in order:
            before, reward = reward, updated(reward, factor, words)
            back = undone(reward)
            np.testing.assert_array_equal(back.weights, before.weights)
            assert (back.smoothness, back.duration_s, back.robot) == (80.0, 40.0, "panda")
            if before.covariance is None:
                assert back.covariance is None
            else:
                assert back.covariance is not None
                np.testing.assert_array_equal(back.covariance, before.covariance)
        assert [c.evidence for c in reward.history] == ["weights as they were (margin)", *(words for _, words in order)]
        assert reward.history[-1].after == tuple(reward.weights)
        np.testing.assert_array_equal(belief_of(reward).mode, reward.weights)
        ends.append(reward)
    np.testing.assert_allclose(ends[0].weights, ends[1].weights, atol=1e-9)
    one, other = (belief_of(end).covariance for end in ends)
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_given_weights_with_a_covariance_begin_with_it() -> None:
    covariance = np.array([[0.2, 0.05], [0.05, 0.4]])
    reward = updated(replace(REWARD, method="given", covariance=covariance), PUSH, "a push")
    np.testing.assert_allclose(reward.weights, REWARD.weights + covariance @ PUSH.difference)
    for found in (reward.covariance, undone(reward).covariance):
        assert found is not None
        np.testing.assert_allclose(found, covariance)
    with pytest.raises(InputError, match=r"nothing to undo: .* began with \(weights as they were \(given\)\)"):
        undone(undone(reward))
    with pytest.raises(InputError, match="nothing to undo"):
        undone(REWARD)


def test_a_change_without_a_factor_forgets_what_was_before() -> None:
    reward = updated(REWARD, CHOICES[0], "an answer").changed(
        np.array([1.0, 2.0]), "one feature", None, covariance=None
    )
    np.testing.assert_allclose(belief_of(reward).mode, [1.0, 2.0])
    assert len(belief_of(reward).factors) == 1
    with pytest.raises(
        InputError, match="a push has 3 numbers, expected 2, one for each of person_closeness, cup_tilt"
    ):
        updated(REWARD, PushFactor(np.zeros(3)), "a push")
