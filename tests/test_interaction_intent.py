import numpy as np
import pytest
import torch
from scipy import stats

from lfd.core.errors import InputError
from lfd.interaction.continuous_intent import (
    log_likelihood_laplace,
    log_likelihood_quadrature,
    log_likelihood_samples,
)
from lfd.interaction.information import information_gain, information_several_steps
from lfd.interaction.intent import IntentBelief, boltzmann_likelihood


@pytest.fixture
def table():
    rewards = torch.randn(3, 2, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return boltzmann_likelihood(rewards, rationality=2.0)


def test_a_belief_is_bayes_rule_whatever_the_order() -> None:
    prior, likelihoods = torch.tensor([0.2, 0.5, 0.3]), torch.tensor([[0.1, 0.4, 0.2], [0.9, 0.3, 0.6]])
    expected = (prior * likelihoods.prod(dim=0)).double()
    expected /= expected.sum()
    for order in ([0, 1], [1, 0]):
        belief = IntentBelief([1.0, 2.0, 4.0], prior)
        for number in order:
            belief = belief.updated(torch.log(likelihoods[number]))
        torch.testing.assert_close(belief.probabilities, expected, atol=1e-6, rtol=0.0)
        assert float(belief.mean) == pytest.approx(float(expected @ torch.tensor([1.0, 2.0, 4.0]).double()), abs=1e-6)
        assert float(belief.entropy) == pytest.approx(stats.entropy(expected.numpy()), abs=1e-6)


def test_a_belief_survives_what_is_far_below_the_smallest_number() -> None:
    belief = IntentBelief([0, 1], torch.tensor([0.5, 0.5]))
    for _ in range(50):
        belief = belief.updated(torch.tensor([-100.0, 0.0]))
    for _ in range(50):
        belief = belief.updated(torch.tensor([0.0, -100.0]))
    torch.testing.assert_close(belief.probabilities, torch.tensor([0.5, 0.5], dtype=torch.float64))
    assert belief.log_probabilities.dtype == torch.float64


def test_thetas_may_be_vectors() -> None:
    belief = IntentBelief(torch.tensor([[1.0, 0.0], [0.0, 2.0]]), torch.tensor([0.25, 0.75]))
    torch.testing.assert_close(belief.mean, torch.tensor([0.25, 1.5], dtype=torch.float64))


def test_the_boltzmann_table_is_normalised_for_each_theta() -> None:
    rewards = torch.tensor([[[1.0, 2.0]], [[100.0, 101.0]], [[1000.0, 0.0]]])
    table = boltzmann_likelihood(rewards, rationality=1.0)
    expected = [1.0 / (1.0 + np.exp(1.0)), 1.0 / (1.0 + np.exp(-1.0))]
    np.testing.assert_allclose(table[:2, 0].numpy(), [expected, expected])
    np.testing.assert_allclose(table[2, 0].numpy(), [1.0, 0.0])


def test_information_is_mutual_information_and_the_mean_drop_of_entropy(table) -> None:
    b = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    gains = information_gain(b, table)
    for action in range(2):
        joint = (b[:, None] * table[:, action]).numpy()
        parts = stats.entropy(joint.sum(axis=0)) + stats.entropy(joint.sum(axis=1)) - stats.entropy(joint.ravel())
        assert float(gains[action]) == pytest.approx(parts, abs=1e-12)
        drop = 0.0
        for answer in range(4):
            after = IntentBelief([0, 1, 2], b).updated(torch.log(table[:, action, answer]))
            drop += joint[:, answer].sum() * (stats.entropy(b.numpy()) - float(after.entropy))
        assert float(gains[action]) == pytest.approx(drop, abs=1e-12)


def test_several_steps_are_joint_and_repeat_less_than_the_sum(table) -> None:
    b = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    one, two = information_gain(b, table), information_several_steps(b, table, 2)
    torch.testing.assert_close(information_several_steps(b, table, 1), one)
    for number, (first, second) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1)]):
        joint = np.einsum("p,pa,pb->pab", b.numpy(), table[:, first].numpy(), table[:, second].numpy())
        parts = stats.entropy(joint.sum(axis=0).ravel()) + stats.entropy(b.numpy()) - stats.entropy(joint.ravel())
        assert float(two[number]) == pytest.approx(parts, abs=1e-12)
        assert float(one.max()) - 1e-12 <= float(two.max())
        assert float(two[number]) <= float(one[first] + one[second]) + 1e-12


def reward(u):
    return -2.0 * (u[0] - 0.3) ** 2 - u[1] ** 2 + 0.5 * u[0] * u[1]


def test_quadrature_laplace_and_samples_agree_with_the_gaussian() -> None:
    precision = np.array([[4.0, -0.5], [-0.5, 2.0]])
    mean = np.linalg.solve(precision, [4.0 * 0.3, 0.0])
    gaussian = stats.multivariate_normal(mean, cov=np.linalg.inv(precision))  # pyright: ignore[reportArgumentType]
    u = torch.tensor([0.1, -0.4], dtype=torch.float64)
    expected = gaussian.logpdf(u.numpy())
    assert log_likelihood_laplace(reward, u) == pytest.approx(expected, abs=1e-10)
    assert log_likelihood_quadrature(reward, u, bounds=(-6.0, 6.0)) == pytest.approx(expected, abs=1e-6)
    wide = stats.multivariate_normal([0.0, 0.0], cov=np.eye(2))  # pyright: ignore[reportArgumentType]
    drawn = wide.rvs(20000, random_state=0)
    found = log_likelihood_samples(reward, u, torch.from_numpy(drawn), torch.from_numpy(wide.logpdf(drawn)))
    assert found.value == pytest.approx(expected, abs=4.0 * found.standard_error)
    assert 1000.0 < found.effective_samples < 20000.0


def test_the_normaliser_depends_on_theta() -> None:
    def theta_reward(theta):
        return lambda u: -theta * (u[0] - 0.5) ** 2

    u = torch.tensor([0.5], dtype=torch.float64)
    low, high = (log_likelihood_laplace(theta_reward(theta), u) for theta in (1.0, 10.0))
    assert high - low == pytest.approx(0.5 * np.log(10.0))  # R_H alone is 0 for both


def test_what_is_no_belief_is_said(table) -> None:
    with pytest.raises(InputError, match="thetas is empty"):
        IntentBelief([], torch.zeros(0))
    with pytest.raises(InputError, match=r"prior has shape \(2,\), expected \(1,\)"):
        IntentBelief([1.0], torch.ones(2))
    with pytest.raises(InputError, match="not negative"):
        IntentBelief([1.0, 2.0], torch.tensor([-0.5, 1.5]))
    belief = IntentBelief([0, 1], torch.tensor([1.0, 0.0]))
    with pytest.raises(InputError, match="impossible under every theta"):
        belief.updated(torch.tensor([-torch.inf, 0.0]))
    with pytest.raises(InputError, match="NaN"):
        belief.updated(torch.tensor([torch.nan, 0.0]))
    with pytest.raises(InputError, match="must sum to 1"):
        information_gain(torch.ones(3) / 3.0, table * 0.9)
    with pytest.raises(InputError, match="sum to 1"):
        information_gain(torch.ones(3), table)
    with pytest.raises(InputError, match="expected"):
        information_gain(torch.ones(2) / 2.0, table)
    with pytest.raises(InputError, match=r"rewards\[0, 1, 0\] is nan"):
        boltzmann_likelihood(torch.tensor([[[0.0], [torch.nan]]]), rationality=1.0)
    with pytest.raises(InputError, match="finite bounds"):
        log_likelihood_quadrature(reward, torch.zeros(2, dtype=torch.float64), bounds=(-torch.inf, 1.0))


def test_the_package_hands_on_functions_whatever_was_imported_before() -> None:
    import lfd.interaction

    for name in lfd.interaction.__all__:
        assert callable(getattr(lfd.interaction, name)), name
