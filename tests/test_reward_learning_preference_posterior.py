import numpy as np
import pytest
from scipy import stats

from lfd.core.errors import InputError, UnknownName
from lfd.reward_learning.choices import log_likelihood
from lfd.reward_learning.preference_posterior import PreferencePosterior
from lfd.reward_learning.slice_sampling import elliptical_steps
from lfd.rewards.factors import Choice

ANSWERS: list[tuple[np.ndarray, np.ndarray, Choice]] = [
    (np.array([1.0, 0.2]), np.array([0.1, 0.4]), "a"),
    (np.array([0.3, -0.5]), np.array([0.2, 0.9]), "b"),
    (np.array([0.7, 0.1]), np.array([0.1, -0.4]), "equal"),
    (np.array([0.0, 0.6]), np.array([0.5, 0.2]), "a"),
]


def posterior(kind: str, prior: str, *, size: int = 2, seed: int = 0, rationality: float = 2.0) -> PreferencePosterior:
    return PreferencePosterior(
        size,
        rationality=rationality,
        prior=prior,  # pyright: ignore[reportArgumentType]
        likelihood=kind,  # pyright: ignore[reportArgumentType]
        rng=np.random.default_rng(seed),
    )


def test_the_choice_models_are_their_formulas() -> None:
    x = np.array([-2.0, 0.0, 0.5])
    np.testing.assert_allclose(np.exp(log_likelihood("bradley_terry", x, "a")), 1.0 / (1.0 + np.exp(-x)))
    np.testing.assert_allclose(np.exp(log_likelihood("bradley_terry", x, "b")), 1.0 / (1.0 + np.exp(x)))
    np.testing.assert_allclose(np.exp(log_likelihood("sadigh2017", x, "a")), np.minimum(1.0, np.exp(x)))
    np.testing.assert_array_equal(np.exp(log_likelihood("hard", x, "b")), [1.0, 1.0, 0.0])
    np.testing.assert_allclose(log_likelihood("sadigh2017", x, "equal"), -np.abs(x) / 2.0)


@pytest.mark.parametrize("kind", ["bradley_terry", "sadigh2017", "hard"])
def test_samples_on_the_circle_have_the_density_of_a_fine_grid(kind) -> None:
    made = posterior(kind, "sphere")
    for answer in ANSWERS[:2] if kind == "hard" else ANSWERS:
        made.update(*answer)
    edges = np.linspace(-np.pi, np.pi, 2001)
    middle = (edges[1:] + edges[:-1]) / 2
    density = np.exp(made.log_density(np.column_stack([np.cos(middle), np.sin(middle)])))
    drawn = made.sample(20000)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0)
    bins = density.reshape(40, 50).sum(axis=1) / density.sum()
    counted, _ = np.histogram(np.arctan2(drawn[:, 1], drawn[:, 0]), edges[::50])
    np.testing.assert_allclose(counted / len(drawn), bins, atol=0.012)
    mean = (density[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])).sum(axis=0) / density.sum()
    np.testing.assert_allclose(made.mean, mean, atol=0.03)


@pytest.mark.parametrize("size", [2, 3])
def test_samples_in_the_ball_have_the_moments_of_a_fine_grid(size) -> None:
    made = posterior("bradley_terry", "ball", size=size, rationality=6.0)
    for f_a, f_b, choice in ANSWERS:
        made.update(np.append(f_a, 0.4)[:size], np.append(f_b, -0.3)[:size], choice)
    axis = np.linspace(-1.0, 1.0, 121)
    grid = np.stack(np.meshgrid(*[axis] * size, indexing="ij"), axis=-1).reshape(-1, size)
    density = np.exp(made.log_density(grid))
    assert (density[np.linalg.norm(grid, axis=1) > 1.0 + 1e-9] == 0.0).all()
    mean = (density[:, None] * grid).sum(axis=0) / density.sum()
    square = (density[:, None] * grid**2).sum(axis=0) / density.sum()
    drawn = made.sample(20000)
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose((drawn**2).mean(axis=0), square, atol=0.02)


@pytest.mark.parametrize("prior", ["sphere", "ball"])
def test_without_answers_samples_are_the_prior(prior) -> None:
    drawn = posterior("bradley_terry", prior, size=3).sample(4000)
    radius = np.linalg.norm(drawn, axis=1)
    if prior == "ball":
        assert stats.kstest(radius**3, "uniform").pvalue > 1e-3
    assert stats.kstest(drawn[:, 0] / radius, "uniform", args=(-1.0, 2.0)).pvalue > 1e-3  # Archimedes


def test_slice_sampling_leaves_a_gaussian_posterior_as_it_is(rng) -> None:
    def likelihood(z: np.ndarray) -> np.ndarray:  # of one observation 1.0 of z_0 with variance 0.25
        return -((z[:, 0] - 1.0) ** 2) / 0.5

    states = rng.standard_normal((4000, 2))
    states = elliptical_steps(states, likelihood(states), likelihood, 15, rng)
    assert stats.kstest((states[:, 0] - 0.8) / np.sqrt(0.2), "norm").pvalue > 1e-3
    assert stats.kstest(states[:, 1], "norm").pvalue > 1e-3


def test_contradictory_answers_widen_the_posterior_and_show_in_the_consistency() -> None:
    sure, torn = posterior("bradley_terry", "sphere"), posterior("bradley_terry", "sphere")
    for _ in range(6):
        sure.update(*ANSWERS[0])
        torn.update(*ANSWERS[0])
    before = np.linalg.norm(torn.mean)
    for _ in range(6):
        torn.update(ANSWERS[0][0], ANSWERS[0][1], "b")
    assert np.linalg.norm(torn.mean) < before / 2
    assert sure.consistency > 0.75
    assert torn.consistency == pytest.approx(0.5, abs=0.05)


def test_contradictory_hard_answers_still_give_samples_that_violate_few() -> None:
    made = posterior("hard", "sphere")
    for choice in ("a", "a", "b"):
        made.update(ANSWERS[0][0], ANSWERS[0][1], choice)
    drawn = made.sample(500)
    assert (drawn @ (ANSWERS[0][0] - ANSWERS[0][1]) > 0.0).all()


def test_after_many_answers_the_mean_is_that_of_a_weighted_prior_and_a_generator_repeats_itself(rng) -> None:
    truth = np.array([0.6, -0.8, 0.0, 0.0])
    made = [posterior("bradley_terry", "sphere", size=4, rationality=10.0, seed=8) for _ in range(2)]
    for _ in range(30):
        f_a, f_b = rng.normal(size=(2, 4))
        for each in made:
            each.update(f_a, f_b, "a" if truth @ (f_a - f_b) > 0.0 else "b")
    np.testing.assert_array_equal(made[0].sample(10), made[1].sample(10))
    prior = rng.normal(size=(400_000, 4))
    prior /= np.linalg.norm(prior, axis=1, keepdims=True)
    weights = np.exp(made[0].log_density(prior))
    assert weights.sum() ** 2 / (weights**2).sum() > 500.0  # enough of them count
    np.testing.assert_allclose(made[0].mean, weights @ prior / weights.sum(), atol=0.02)


def test_what_is_no_comparison_is_said() -> None:
    made = posterior("bradley_terry", "sphere")
    with pytest.raises(InputError, match="compared with itself"):
        made.update(np.ones(2), np.ones(2), "a")
    with pytest.raises(InputError, match=r"f_b has shape \(3,\), expected \(2,\)"):
        made.update(np.ones(2), np.ones(3), "a")
    with pytest.raises(UnknownName, match="a, b, equal"):
        made.update(np.ones(2), np.zeros(2), "left")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="rationality = -1"):
        posterior("bradley_terry", "sphere", rationality=-1.0)
    with pytest.raises(UnknownName, match="ball, sphere"):
        posterior("bradley_terry", "cube")
    with pytest.raises(InputError, match="n = 0"):
        made.sample(0)
    assert len(made) == 0
