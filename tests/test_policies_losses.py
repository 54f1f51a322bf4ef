"""Every divergence against numerical integration, every gradient against finite differences."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from lfd.core.errors import InputError, UnknownName
from lfd.policies.losses import (
    KINDS,
    f_divergence,
    gaussian_f_divergence,
    huber_loss,
    mixture_log_prob,
    monte_carlo_f_divergence,
    mse,
    p_norm_loss,
)

LOG_2 = math.log(2)
F = {  # D_f = sum q f(p/q), as the docstring states f
    "kl": lambda t: t * np.log(t),
    "reverse_kl": lambda t: -np.log(t),
    "js": lambda t: (t * np.log(t) - (t + 1) * np.log((t + 1) / 2)) / 2,
    "tv": lambda t: np.abs(t - 1) / 2,
    "chi2": lambda t: (t - 1) ** 2,
    "hellinger2": lambda t: 1 - np.sqrt(t),
}
BOUNDS = {"kl": math.inf, "reverse_kl": math.inf, "js": LOG_2, "tv": 1, "chi2": math.inf, "hellinger2": 1}


def wide(values: object) -> Tensor:
    return torch.as_tensor(np.asarray(values), dtype=torch.float64)


def log_normal(x: np.ndarray, mean: float, std: float) -> np.ndarray:
    return -(((x - mean) / std) ** 2) / 2 - math.log(std * math.sqrt(2 * math.pi))


def integral(kind: str, log_p: np.ndarray, log_q: np.ndarray, cell: float) -> float:
    """The integral that each kind is, over a grid."""
    p, q, away = np.exp(log_p), np.exp(log_q), log_p - log_q
    terms = {
        "kl": lambda: p * away,
        "reverse_kl": lambda: -q * away,
        "js": lambda: (p * (LOG_2 - np.logaddexp(0, -away)) + q * (LOG_2 - np.logaddexp(0, away))) / 2,
        "tv": lambda: np.abs(p - q) / 2,
        "chi2": lambda: np.exp(2 * log_p - log_q) - q,
        "hellinger2": lambda: (np.sqrt(p) - np.sqrt(q)) ** 2 / 2,
    }
    return float(terms[kind]().sum() * cell)


# Between actions.
@pytest.mark.parametrize("p", [1, 1.0, 1.5, 2, 3.0, 7, math.inf])
def test_p_norms_are_numpys_and_their_gradients_those_of_finite_differences(p: float) -> None:
    rng = np.random.default_rng(0)
    expert, learner = rng.normal(size=(2, 20, 5))
    value = p_norm_loss(wide(expert), wide(learner), p=p)
    np.testing.assert_allclose(
        value,
        np.linalg.norm(learner - expert, ord=p, axis=-1)
        if p in (1, 2, math.inf)
        else (np.abs(learner - expert) ** p).sum(-1) ** (1 / p),
        rtol=1e-12,
    )
    assert gradcheck(lambda u: p_norm_loss(wide(expert), u, p=p), wide(learner).requires_grad_())


@pytest.mark.parametrize("p", [1, 1.5, 2, 3, 50, math.inf])
def test_p_norms_have_no_gradient_at_zero_and_do_not_underflow(p: float) -> None:
    expert = torch.zeros(2, 4)
    learner = torch.tensor([[0.0] * 4, [1e-6, 0, 0, 0]], requires_grad=True)
    value = p_norm_loss(expert, learner, p=p)
    (gradient,) = torch.autograd.grad(value.sum(), learner)
    torch.testing.assert_close(value, torch.tensor([0, 1e-6]))
    torch.testing.assert_close(gradient, torch.tensor([[0.0] * 4, [1.0, 0, 0, 0]]))


@pytest.mark.parametrize("p", [0.5, 0, -1, math.nan])
def test_what_is_no_norm_is_refused(p: float) -> None:
    with pytest.raises(InputError, match="is no norm; give p >= 1, or inf"):
        p_norm_loss(torch.zeros(1, 2), torch.zeros(1, 2), p=p)


def test_huber_is_half_the_square_inside_and_linear_outside() -> None:
    expert, learner = torch.zeros(2, 2), torch.tensor([[0.1, -0.2], [0.1, 3.0]])
    expected = torch.tensor([0.01 / 2 + 0.04 / 2, 0.01 / 2 + 0.5 * (3 - 0.25)])
    torch.testing.assert_close(huber_loss(expert, learner, delta=0.5), expected)
    with pytest.raises(InputError, match="must be greater than 0"):
        huber_loss(expert, learner, delta=0)


def test_mse_is_the_mean_over_components() -> None:
    rng = np.random.default_rng(1)
    expert, learner = rng.normal(size=(2, 6, 3))
    np.testing.assert_allclose(mse(wide(expert), wide(learner)), ((expert - learner) ** 2).sum(-1) / 3)


def test_shapes_that_would_broadcast_are_refused() -> None:
    for loss in (mse, lambda a, b: p_norm_loss(a, b, p=2), lambda a, b: f_divergence(a, b, kind="kl")):
        with pytest.raises(InputError, match=r"shapes \(3, 2\) and \(1, 2\) differ"):
            loss(torch.full((3, 2), 0.5), torch.zeros(1, 2))
    with pytest.raises(InputError, match=r"shapes \(3, 2\) and \(2,\) differ"):
        gaussian_f_divergence(torch.zeros(3, 2), torch.ones(2), torch.zeros(3, 2), torch.ones(3, 2), kind="kl")


# Between categorical distributions.
@pytest.mark.parametrize("kind", KINDS)
def test_categorical_divergences_are_the_sum_that_defines_them(kind: str) -> None:
    rng = np.random.default_rng(2)
    p, logits = rng.dirichlet(np.ones(6), size=(4, 3)), rng.normal(size=(4, 3, 6)) * 2
    q = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    value = f_divergence(wide(p), wide(logits), kind=kind)
    np.testing.assert_allclose(value, (q * F[kind](p / q)).sum(-1), rtol=1e-10)
    assert gradcheck(lambda raw: f_divergence(wide(p), raw, kind=kind), wide(logits).requires_grad_())


@pytest.mark.parametrize("kind", KINDS)
def test_an_expert_that_excludes_actions_leaves_values_and_gradients_finite(kind: str) -> None:
    p = torch.tensor([[0.0, 1.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])
    logits = torch.tensor([[0.3, 0.1, -2.0], [80.0, -80.0, 0.0], [-300.0, 300.0, 0.0]], requires_grad=True)
    value = f_divergence(p, logits, kind=kind)
    (gradient,) = torch.autograd.grad(value[:2].sum() if kind == "reverse_kl" else value.sum(), logits)
    assert torch.isfinite(gradient).all()
    q = logits.detach().double().softmax(-1)
    expected = {
        "kl": torch.tensor([-math.log(q[0, 1]), 80 - LOG_2, 600]),
        "reverse_kl": torch.full((3,), math.inf),  # -log 0 where q is not 0
        "js": torch.tensor(
            [
                float(
                    -q[0, 1] * torch.log((1 + q[0, 1]) / 2 / q[0, 1])
                    - torch.log((1 + q[0, 1]) / 2)
                    + (1 - q[0, 1]) * LOG_2
                )
                / 2,
                0.215762,
                LOG_2,
            ]
        ),
        "tv": torch.tensor([1 - float(q[0, 1]), 0.5, 1]),
        "chi2": torch.tensor([1 / float(q[0, 1]) - 1, torch.finfo().max / math.e, torch.finfo().max / math.e]),
        "hellinger2": torch.tensor([1 - float(q[0, 1].sqrt()), 1 - math.sqrt(0.5), 1]),
    }
    torch.testing.assert_close(value, expected[kind].float(), rtol=1e-4, atol=1e-5)


def test_what_is_no_kind_and_what_is_no_distribution() -> None:
    p, logits = torch.full((1, 2), 0.5), torch.zeros(1, 2)
    with pytest.raises(
        UnknownName, match="unknown f-divergence 'kld'; known: chi2, hellinger2, js, kl, reverse_kl, tv"
    ):
        f_divergence(p, logits, kind="kld")
    with pytest.raises(UnknownName, match="unknown f-divergence"):
        gaussian_f_divergence(logits, p, logits, p, kind="JS")
    for wrong in ([[0.5, 0.4]], [[1.5, -0.5]]):
        with pytest.raises(InputError, match="negative or do not sum to 1"):
            f_divergence(torch.tensor(wrong), logits, kind="kl")


distributions = st.lists(st.floats(-6, 6), min_size=4, max_size=4).map(wide)


@given(distributions, distributions)
def test_invariants_of_categorical_divergences(a: Tensor, b: Tensor) -> None:
    p, q = a.softmax(-1)[None], b.softmax(-1)[None]
    value = {kind: float(f_divergence(p, b[None], kind=kind)) for kind in KINDS}
    for kind in KINDS:
        assert -1e-9 <= value[kind] <= BOUNDS[kind] + 1e-9
        assert abs(float(f_divergence(p, a[None], kind=kind))) < 1e-9
    for kind in ("js", "tv", "hellinger2"):
        assert value[kind] == pytest.approx(float(f_divergence(q, a[None], kind=kind)), abs=1e-9)
    assert value["reverse_kl"] == pytest.approx(float(f_divergence(q, a[None], kind="kl")), abs=1e-9)
    between_the_kinds(value)


def between_the_kinds(value: dict[str, float]) -> None:
    """Inequalities that hold between the divergences of any two distributions."""
    assert value["hellinger2"] <= value["tv"] + 1e-6
    assert value["tv"] ** 2 <= min(value["kl"], value["reverse_kl"]) / 2 + 1e-6  # Pinsker
    assert value["kl"] <= math.log1p(value["chi2"]) + 1e-6 or value["chi2"] > 1e307  # where chi2 ends
    assert value["js"] <= value["tv"] * LOG_2 + 1e-6


# Between Gaussians.
ON_A_LINE = [
    (m, s, n, t)
    for (m, n), (s, t) in product(
        [(0.0, 0.0), (0.3, 0.31), (0.2, -0.4), (-1.0, 2.0)],
        [(0.5, 0.5), (0.5, 0.500001), (0.5, 0.51), (0.5, 0.37), (1.0, 0.2), (0.1, 1.5), (0.02, 1.0)],
    )
]


@pytest.mark.parametrize("kind", KINDS)
def test_gaussians_on_a_line_against_integration(kind: str) -> None:
    m, s, n, t = (wide([[row[i]] for row in ON_A_LINE]) for i in range(4))
    values = gaussian_f_divergence(m, s, n, t, kind=kind)
    for value, (m1, s1, n1, t1) in zip(values.tolist(), ON_A_LINE, strict=True):
        if kind == "chi2" and 2 * t1**2 <= s1**2:
            assert value == math.inf
            continue
        if kind == "chi2" and 2 * t1**2 < 1.2 * s1**2:  # p^2/q is much wider than both
            continue
        x = np.linspace(min(m1 - 38 * s1, n1 - 38 * t1), max(m1 + 38 * s1, n1 + 38 * t1), 400_001)
        expected = integral(kind, log_normal(x, m1, s1), log_normal(x, n1, t1), x[1] - x[0])
        if expected < 1e12:
            assert value == pytest.approx(expected, rel=1e-6, abs=1e-7), (m1, s1, n1, t1)


PLANE = [
    ((0.0, 0.0), (0.5, 0.4), (0.1, -0.2), (0.6, 0.3)),
    ((0.0, 0.0), (0.5, 0.4), (0.0, 0.0), (0.5, 0.4)),
    ((0.0, 0.1), (0.3, 0.3), (0.5, -0.2), (0.3, 0.3)),
    ((0.0, 0.1), (0.3, 0.3), (0.5, -0.2), (0.3, 0.301)),
    ((1.0, 0.0), (0.2, 0.9), (-0.5, 0.3), (0.7, 0.8)),
    ((0.0, 0.0), (0.1, 0.1), (0.1, 0.3), (0.8, 0.4)),
]


@pytest.mark.parametrize("kind", KINDS)
def test_gaussians_in_a_plane_against_integration(kind: str) -> None:
    values = gaussian_f_divergence(*(wide([row[i] for row in PLANE]) for i in range(4)), kind=kind)
    x, y = np.meshgrid(np.linspace(-9, 9, 1201), np.linspace(-9, 9, 1201))
    for value, (m, s, n, t) in zip(values.tolist(), PLANE, strict=True):
        p = log_normal(x, m[0], s[0]) + log_normal(y, m[1], s[1])
        q = log_normal(x, n[0], t[0]) + log_normal(y, n[1], t[1])
        if kind in ("js", "tv") and not (kind == "tv" and s == t):
            relative, absolute = 0.0, 3e-4  # nodes
        else:
            relative, absolute = 1e-6, 5e-5 if kind == "tv" else 1e-7  # the grid, where |p - q| has a kink
        expected = integral(kind, p, q, (18 / 1200) ** 2)
        assert value == pytest.approx(expected, rel=relative, abs=absolute), (m, s, n, t)


def test_seven_components_of_equal_stds_are_a_line() -> None:
    """Only Mahalanobis' distance d matters then: js and tv are those of N(0, 1) and N(d, 1)."""
    rng = np.random.default_rng(3)
    m, away, s = rng.normal(size=(20, 7)), rng.normal(size=(20, 7)) * 0.4, rng.uniform(0.05, 0.5, (20, 7))
    distance = wide(np.linalg.norm(away, axis=-1, keepdims=True))
    zero, one = torch.zeros_like(distance), torch.ones_like(distance)
    nearly = s * (1 + 1e-10)  # not equal any more: nodes
    for kind, tolerance in (("js", 1e-3), ("tv", 2e-3)):
        expected = gaussian_f_divergence(zero, one, distance, one, kind=kind)
        value = gaussian_f_divergence(wide(m), wide(s), wide(m + s * away), wide(nearly), kind=kind)
        torch.testing.assert_close(value, expected, rtol=0, atol=tolerance)
    exact = gaussian_f_divergence(wide(m), wide(s), wide(m + s * away), wide(s), kind="tv")
    torch.testing.assert_close(exact, torch.erf(distance[:, 0] / math.sqrt(8)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1, 3])
def test_gradients_of_gaussian_divergences(kind: str, size: int) -> None:
    rng = np.random.default_rng(4)
    m, n = wide(rng.normal(size=(2, 5, size)) * 0.3)
    s, t = wide(rng.uniform(0.3, 0.5, (2, 5, size)))
    t[0] = s[0]

    def value(mean: Tensor, std: Tensor) -> Tensor:
        return gaussian_f_divergence(m, s, mean, std, kind=kind, samples=256)

    if kind == "tv":
        t[0] *= 1.001  # at equal stds finite differences would cross from one form to the other
    assert gradcheck(value, (n.requires_grad_(), t.requires_grad_()), eps=1e-7, atol=1e-4)


def test_the_gradient_of_tv_at_equal_stds_is_the_one_beside_it() -> None:
    m, s, n = wide([[0.0, 0.1]]), wide([[0.3, 0.4]]), wide([[0.2, -0.2]]).requires_grad_()
    gradients = []
    for factor in (1.0, 1 + 1e-8):
        t = (s * factor).requires_grad_()
        gradients.append(torch.autograd.grad(gaussian_f_divergence(m, s, n, t, kind="tv").sum(), (n, t)))
    for equal, beside in zip(*gradients, strict=True):
        torch.testing.assert_close(equal, beside, rtol=0, atol=5e-3)
        assert (equal != 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1, 2, 7])
def test_equal_gaussians_are_at_zero_and_far_ones_have_finite_gradients(kind, dtype, size) -> None:
    m = torch.linspace(-1, 1, size, dtype=dtype).expand(3, size)
    s = torch.full_like(m, 0.05)
    n = (m + torch.tensor([[0.0], [2.0], [1e3]], dtype=dtype)).requires_grad_()
    t = (s * torch.tensor([[1.0], [1.0], [20.0]], dtype=dtype)).requires_grad_()
    value = gaussian_f_divergence(m, s, n, t, kind=kind, samples=512)
    for gradient in torch.autograd.grad(value.sum(), (n, t)):
        assert torch.isfinite(gradient).all()
    value = value.detach()
    assert value[0].abs() < 1e-5
    assert (value[1:] > 0.5).all()
    assert (value <= BOUNDS[kind] * (1 + 1e-5)).all()


def test_chi2_of_a_narrow_learner_is_infinite_without_a_gradient() -> None:
    m, s, n = torch.zeros(2, 2), torch.ones(2, 2), torch.zeros(2, 2)
    t = torch.tensor([[1.0, 0.7], [1.0, 0.72]], requires_grad=True)
    value = gaussian_f_divergence(m, s, n, t, kind="chi2")
    assert value[0] == math.inf
    assert torch.isfinite(value[1])
    (gradient,) = torch.autograd.grad(value.sum(), t)
    assert torch.isfinite(gradient).all()
    assert gradient[1, 1] < 0


stds, means = st.floats(0.05, 3), st.floats(-2, 2)


@given(means, stds, means, stds)
def test_invariants_of_gaussian_divergences(m1: float, s1: float, n1: float, t1: float) -> None:
    m, s, n, t = (wide([[v]]) for v in (m1, s1, n1, t1))
    value = {kind: float(gaussian_f_divergence(m, s, n, t, kind=kind)) for kind in KINDS}
    for kind in KINDS:
        assert -1e-9 <= value[kind] <= BOUNDS[kind] + 1e-9
    for kind in ("js", "tv", "hellinger2"):
        assert value[kind] == pytest.approx(float(gaussian_f_divergence(n, t, m, s, kind=kind)), abs=1e-9)
    between_the_kinds(value)


def test_the_generator_of_the_caller_is_left_alone() -> None:
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    gaussian_f_divergence(
        torch.zeros(1, 5), torch.ones(1, 5), torch.ones(1, 5), torch.ones(1, 5), kind="js", samples=34
    )
    torch.testing.assert_close(torch.rand(1), expected, rtol=0, atol=0)


# Between a Gaussian and a mixture.
def test_the_density_of_a_mixture_is_torchs() -> None:
    generator = torch.Generator().manual_seed(5)
    logits, means, actions = (torch.randn(shape, generator=generator) for shape in ((4, 3), (4, 3, 2), (4, 2)))
    stds = torch.rand(4, 3, 2, generator=generator) + 0.1
    normals = torch.distributions.Independent(torch.distributions.Normal(means, stds), 1)
    expected = torch.distributions.MixtureSameFamily(torch.distributions.Categorical(logits=logits), normals)
    torch.testing.assert_close(mixture_log_prob(logits, means, stds, actions), expected.log_prob(actions))


MIXTURES = [  # expert's mean and std, the learner's logits, means and stds
    (0.0, 0.5, (0.0, 0.0), (-0.3, 0.4), (0.5, 0.6)),
    (0.5, 0.2, (1.0, -1.0), (0.5, -0.5), (0.2, 0.3)),
    (0.5, 0.1, (0.0, 2.0), (0.5, -0.5), (0.1, 0.1)),
    (-0.2, 0.3, (0.0, 0.0), (-0.2, -0.2), (0.3, 0.3)),
]


@pytest.mark.parametrize("kind", KINDS)
def test_a_gaussian_and_a_mixture_on_a_line_against_integration(kind: str) -> None:
    x = np.linspace(-12, 12, 400_001)
    columns = zip(*MIXTURES, strict=True)
    mean, std, logits, means, stds = (wide(column) for column in columns)
    args = (mean[:, None], std[:, None], logits, means[..., None], stds[..., None])
    values = monte_carlo_f_divergence(*args, kind=kind, samples=1024)
    for value, (m, s, raw, n, t) in zip(values.tolist(), MIXTURES, strict=True):
        weights = np.exp(raw) / np.exp(raw).sum()
        q = np.logaddexp.reduce([math.log(w) + log_normal(x, a, b) for w, a, b in zip(weights, n, t, strict=True)])
        assert value == pytest.approx(integral(kind, log_normal(x, m, s), q, x[1] - x[0]), rel=1e-5, abs=2e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_a_mixture(kind: str) -> None:
    generator = torch.Generator().manual_seed(6)
    draw = lambda *shape: torch.rand(shape, generator=generator, dtype=torch.float64)  # noqa: E731
    mean, std = draw(2, 2), draw(2, 2) * 0.1 + 0.2
    learner = tuple(v.requires_grad_() for v in (draw(2, 3), draw(2, 3, 2), draw(2, 3, 2) * 0.2 + 0.3))
    assert gradcheck(
        lambda *q: monte_carlo_f_divergence(mean, std, *q, kind=kind, samples=64), learner, eps=1e-7, atol=1e-5
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_mixture_of_one_is_a_gaussian(kind: str) -> None:
    rng = np.random.default_rng(7)
    m, n = wide(rng.normal(size=(2, 8, 3)) * 0.2)
    s, t = wide(rng.uniform(0.3, 0.4, (8, 3))), wide(rng.uniform(0.4, 0.5, (8, 3)))
    logits = torch.zeros(8, 1, dtype=torch.float64)
    value = monte_carlo_f_divergence(m, s, logits, n[:, None], t[:, None], kind=kind, samples=16384)
    torch.testing.assert_close(
        value, gaussian_f_divergence(m, s, n, t, kind=kind), rtol=2e-2 if kind == "chi2" else 0, atol=1e-3
    )
