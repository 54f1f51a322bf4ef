import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from lfd.core.errors import InputError
from lfd.reward_learning import NotConcave, laplace_log_likelihood, maxent_laplace
from tests.small_mdps import numerical_gradient


def parabola(seed: int, size: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.5 * np.eye(size), rng.normal(size=size)


@pytest.mark.parametrize("seed", range(4))
def test_exact_for_quadratic_rewards_wherever_the_demonstration_is(seed: int) -> None:
    bend, top = parabola(seed)
    bend_torch, top_torch = torch.from_numpy(bend), torch.from_numpy(top)
    controls = np.random.default_rng(seed + 100).normal(size=4)
    found = laplace_log_likelihood(lambda u: -0.5 * (u - top_torch) @ bend_torch @ (u - top_torch) + 3.0, controls)
    exact = -0.5 * (controls - top) @ bend @ (controls - top) + 0.5 * np.log(np.linalg.det(bend / (2 * np.pi)))
    assert found == pytest.approx(exact, abs=1e-10)


def test_near_for_a_reward_that_is_nearly_quadratic() -> None:
    def reward(u: torch.Tensor) -> torch.Tensor:
        return -5 * (u**2).sum() - 0.5 * (u**4).sum()

    total = quad(lambda u: np.exp(-5 * u**2 - 0.5 * u**4), -5, 5)[0]
    exact = -5 * 0.1**2 - 0.5 * 0.1**4 - np.log(total)
    assert laplace_log_likelihood(reward, np.array([0.1])) == pytest.approx(exact, abs=0.02)


def test_off_by_log_2_where_a_second_optimum_is_as_good() -> None:
    def reward(u: torch.Tensor) -> torch.Tensor:
        return -20 * ((u**2 - 1) ** 2).sum()

    total = quad(lambda u: np.exp(-20 * (u**2 - 1) ** 2), -3, 3, points=[-1, 1])[0]
    assert laplace_log_likelihood(reward, np.array([1.0])) - (-np.log(total)) == pytest.approx(np.log(2), abs=0.02)


@pytest.mark.parametrize(
    "reward", [lambda u: (u**2).sum(), lambda u: u.sum(), lambda u: -(u[0] ** 2), lambda u: u[0] ** 2 - u[1] ** 2]
)
def test_no_strict_optimum_is_an_error_that_says_what_it_means(reward) -> None:
    with pytest.raises(NotConcave, match="it is no strict local maximum of this reward"):
        laplace_log_likelihood(reward, np.array([0.5, 0.2]))


def test_derivatives_that_are_not_finite_are_refused() -> None:
    with pytest.raises(InputError, match=r"gradient of the reward\[0\] is inf"):
        laplace_log_likelihood(lambda u: u.sqrt().sum(), np.array([0.0]))
    with pytest.raises(InputError, match=r"controls has shape \(2, 1\), expected \(n,\)"):
        laplace_log_likelihood(lambda u: -(u**2).sum(), np.zeros((2, 1)))


def costs(u: torch.Tensor) -> torch.Tensor:
    """Effort and distance to 2, of a car on a line whose position adds up its controls."""
    return -torch.stack([(u**2).sum(), ((torch.cumsum(u, 0) - 2) ** 2).sum(), (torch.sin(u) ** 2).sum()])


def test_the_likelihood_of_weights_and_its_gradient() -> None:
    demonstrations = [np.random.default_rng(seed).normal(0.3, 0.1, size=5) for seed in range(3)]
    weights = np.array([2.0, 1.0, 0.1])

    def likelihood(w: np.ndarray) -> float:
        weights = torch.from_numpy(w)
        return sum(laplace_log_likelihood(lambda u: weights @ costs(u), each) for each in demonstrations)

    start = maxent_laplace(costs, demonstrations, initial=weights, l2=0.0, tolerance=1e-8, max_iterations=0)
    assert start.log_likelihood == pytest.approx(likelihood(weights))
    np.testing.assert_allclose(start.gradient, numerical_gradient(likelihood, weights), rtol=1e-5)
    found = maxent_laplace(costs, demonstrations, initial=weights, l2=0.01, tolerance=1e-8, max_iterations=200)
    assert found.converged
    assert found.log_likelihood > start.log_likelihood
    np.testing.assert_allclose(found.gradient, 0, atol=1e-8)


def test_weights_of_a_gaussian_demonstrator_are_found_again() -> None:
    rng = np.random.default_rng(9)
    truth = np.array([3.0, 5.0])

    def features(u: torch.Tensor) -> torch.Tensor:
        return -torch.stack([(u**2).sum(), ((u - 1) ** 2).sum()])

    # exp(w.f) is a Gaussian of precision 2 (w_1 + w_2) around w_2 / (w_1 + w_2)
    shown = rng.normal(5 / 8, np.sqrt(1 / 16), size=(300, 4))
    found = maxent_laplace(
        features, list(shown), initial=np.array([1.0, 1.0]), l2=0.0, tolerance=1e-6, max_iterations=200
    )
    assert found.converged
    np.testing.assert_allclose(found.weights, truth, rtol=0.1)
    precision, mean = 1 / shown.var(), shown.mean()  # the closed form of the maximum
    np.testing.assert_allclose(found.weights, [precision / 2 * (1 - mean), precision / 2 * mean], rtol=1e-6)


def test_a_start_outside_the_domain_names_the_demonstration() -> None:
    with pytest.raises(NotConcave, match="demonstration 0: with the initial weights"):
        maxent_laplace(costs, [np.zeros(3)], initial=-np.ones(3), l2=0.0, tolerance=1e-8, max_iterations=5)
    with pytest.raises(InputError, match="demonstrations is empty"):
        maxent_laplace(costs, [], initial=np.ones(3), l2=0.0, tolerance=1e-8, max_iterations=5)
    with pytest.raises(InputError, match=r"Jacobian of the features of demonstration 0 has shape \(3, 2\)"):
        maxent_laplace(costs, [np.zeros(2)], initial=np.ones(2), l2=0.0, tolerance=1e-8, max_iterations=5)


def test_reward_learning_is_imported_without_torch() -> None:
    code = "import sys, lfd.rewards, lfd.reward_learning; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
