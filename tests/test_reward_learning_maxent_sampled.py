import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.reward_learning import SampledTrajectories, fixed_pool, maxent_sampled, maxent_tabular
from lfd.reward_learning.maxent_sampled import MaxEntSampled, partition
from tests.small_mdps import probability, random_mdp, random_policy, trajectories

OPTIONS = {"tolerance": 1e-9, "max_iterations": 100, "least_share": 0.5}


def test_a_pool_is_a_softmax() -> None:
    rng = np.random.default_rng(0)
    pool, weights = rng.normal(size=(7, 2)), rng.normal(size=2)
    estimate = partition(weights, fixed_pool(pool)(weights))
    worth = np.exp(pool @ weights)
    assert estimate.log_partition == pytest.approx(np.log(worth.sum()))
    np.testing.assert_allclose(estimate.shares, worth / worth.sum())
    np.testing.assert_allclose(estimate.mean, worth @ pool / worth.sum())
    assert estimate.effective_sample_size == pytest.approx(worth.sum() ** 2 / (worth**2).sum())


def test_weights_of_a_softmax_expert_are_found_again() -> None:
    rng = np.random.default_rng(1)
    pool, truth = rng.normal(size=(50, 3)), np.array([1.0, -2.0, 0.5])
    expert = partition(truth, fixed_pool(pool)(truth)).mean
    result = maxent_sampled(expert[None], fixed_pool(pool), initial=np.zeros(3), **OPTIONS)
    assert result.converged
    np.testing.assert_allclose(result.weights, truth, atol=1e-7)
    np.testing.assert_allclose(result.feature_gap, 0, atol=1e-9)
    assert (np.diff(result.log_likelihoods) > -1e-12).all()
    assert len(result.gradient_norms) == len(result.effective_sample_sizes) < 20


def test_importance_weights_undo_the_proposal() -> None:
    # Gaussian trajectories with f = (x, -x^2/2): exp(w.f) is a Gaussian of variance 1/w_2 and mean w_1/w_2.
    rng = np.random.default_rng(2)
    x = rng.normal(0.5, 1.5, size=200_000)
    samples = SampledTrajectories(
        np.stack([x, -(x**2) / 2], axis=1), -0.5 * ((x - 0.5) / 1.5) ** 2 - np.log(1.5 * np.sqrt(2 * np.pi))
    )
    estimate = partition(np.array([0.6, 2.0]), samples)
    mean, variance = 0.3, 0.5
    exact = np.array([mean, -(variance + mean**2) / 2])
    assert (np.abs(estimate.mean - exact) < 5 * estimate.standard_error).all()
    assert estimate.log_partition == pytest.approx(0.5 * np.log(2 * np.pi * variance) + 0.6**2 / (2 * 2.0), abs=0.01)
    assert 1 < estimate.effective_sample_size < 200_000
    assert partition(np.array([0.5, 1.0]) / 1.5**2, samples).effective_sample_size == pytest.approx(200_000)


def test_the_standard_error_is_the_spread_of_the_estimate() -> None:
    rng = np.random.default_rng(3)
    weights = np.array([0.5, 1.5])
    estimates = []
    for _ in range(400):
        x = rng.normal(size=300)
        # Without the density's constant, which only shifts log Z.
        samples = SampledTrajectories(np.stack([x, -(x**2) / 2], axis=1), -0.5 * x**2)
        estimates.append(partition(weights, samples))
    spread = np.std([each.mean[0] for each in estimates])
    assert np.mean([each.standard_error[0] for each in estimates]) == pytest.approx(spread, rel=0.15)


def gaussian_loop(seed: int, **changes) -> MaxEntSampled:
    """Demonstrations of mean 0.8 and variance 0.25; the planner samples a Gaussian wider than exp(w.f)."""
    rng = np.random.default_rng(seed)
    shown = rng.normal(0.8, 0.5, size=2000)

    def plan(weights: np.ndarray) -> SampledTrajectories:
        mean, deviation = weights[0] / weights[1], 1.3 / np.sqrt(weights[1])
        x = rng.normal(mean, deviation, size=4000)
        densities = -0.5 * ((x - mean) / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))
        return SampledTrajectories(np.stack([x, -(x**2) / 2], axis=1), densities)

    options = {"initial": np.array([0.0, 1.0]), "tolerance": 0.01, "max_iterations": 60, "least_share": 0.5}
    return maxent_sampled(np.stack([shown, -(shown**2) / 2], axis=1), plan, **(options | changes))


def test_the_loop_with_a_planner_finds_the_demonstrator() -> None:
    result = gaussian_loop(4)
    assert result.converged
    mean, variance = result.weights[0] / result.weights[1], 1 / result.weights[1]
    assert mean == pytest.approx(0.8, abs=0.05)
    assert variance == pytest.approx(0.25, abs=0.03)
    assert result.effective_sample_size > 2000
    entropy = 0.5 * np.log(2 * np.pi * np.e * 0.25)
    assert result.log_likelihood == pytest.approx(-entropy, abs=0.05)


def test_a_step_keeps_the_samples_representative() -> None:
    result = gaussian_loop(5, initial=np.array([-20.0, 4.0]))
    assert result.converged
    assert result.effective_sample_sizes.min() > 1000


def test_iterations_that_run_out_are_reported() -> None:
    result = gaussian_loop(6, max_iterations=2, initial=np.array([-20.0, 4.0]))
    assert not result.converged
    assert len(result.gradient_norms) == 2


def test_sampled_actions_in_a_stochastic_world_give_the_model_of_2008() -> None:
    mdp = random_mdp(7, discount=1.0)
    rng = np.random.default_rng(7)
    everything, policy = trajectories(mdp), random_policy(mdp, rng)
    weights = np.array([0.8, -0.6])
    worth = np.array([tau.chance * np.exp(weights @ tau.counts) for tau in everything])
    exact = worth @ [tau.counts for tau in everything] / worth.sum()
    chances = np.array([probability(tau, policy) for tau in everything])
    drawn = rng.choice(len(everything), 100_000, p=chances / chances.sum())
    of_actions = np.log(chances / [tau.chance for tau in everything])
    samples = SampledTrajectories(np.array([everything[i].counts for i in drawn]), of_actions[drawn])
    estimate = partition(weights, samples)
    assert (np.abs(estimate.mean - exact) < 5 * estimate.standard_error).all()
    causal = mdp.feature_expectation(mdp.soft_solution(weights).policy)
    assert (np.abs(causal - exact) > 5 * estimate.standard_error).any()
    assert maxent_tabular(mdp, causal).converged


def test_the_regulariser_shrinks() -> None:
    rng = np.random.default_rng(8)
    pool = rng.normal(size=(30, 2))
    result = maxent_sampled(pool[:2], fixed_pool(pool), initial=np.zeros(2), l2=0.5, **OPTIONS)
    assert result.converged
    np.testing.assert_allclose(result.feature_gap, 0.5 * result.weights, atol=1e-8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"demonstrations": np.empty((0, 2))}, "demonstrations has no row"),
        ({"demonstrations": np.array([[0.0, np.inf]])}, r"demonstrations\[0, 1\] is inf"),
        ({"initial": np.zeros(3)}, r"initial has shape \(3,\), expected \(2,\)"),
        ({"l2": -0.1}, "l2 = -0.1"),
        ({"least_share": 1.0}, "least_share = 1.0"),
        ({"max_iterations": 0}, "max_iterations = 0"),
        ({"plan": fixed_pool(np.zeros((3, 1)))}, r"features of plan\(weights\) has shape \(3, 1\)"),
        ({"plan": fixed_pool(np.empty((0, 2)))}, "returned no trajectory"),
        ({"plan": fixed_pool(np.array([[1.0, 0.0], [1.0, 1.0]]))}, "feature 0 is the same in every"),
        (
            {"plan": lambda _: SampledTrajectories(np.eye(2), np.array([0.0, np.nan]))},
            r"log_densities of plan\(weights\)\[1\] is nan",
        ),
    ],
)
def test_what_is_no_problem_is_refused(changes: dict, message: str) -> None:
    parts = {
        "demonstrations": np.array([[1.0, 0.5]]),
        "plan": fixed_pool(np.eye(2)),
        "initial": np.zeros(2),
    } | OPTIONS
    with pytest.raises(InputError, match=message):
        maxent_sampled(**(parts | changes))
