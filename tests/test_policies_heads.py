"""Heads against torch's distributions, against sums over actions, and fitted to experts that are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import ndtr
from torch import Tensor, distributions, nn

from lfd.core.errors import RecipeError, UnknownName
from lfd.policies.heads import LOSSES, HeadSettings, log_normal_bins, make_head
from lfd.policies.losses import KINDS, f_divergence, gaussian_f_divergence, monte_carlo_f_divergence

ALL = [(head, loss) for head, losses in LOSSES.items() for loss in losses]
STOCHASTIC = ("gaussian", "mixture", "discrete")


def settings(head: str, loss: str, action_dim: int = 2, **others: float) -> HeadSettings:
    made = HeadSettings(head=head, action_dim=action_dim, loss=loss, min_std=0.05, **others)  # type: ignore[arg-type]
    made.check("[policy]")
    return made


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# What a recipe may ask for.
@pytest.mark.parametrize(("head", "loss"), ALL)
def test_every_head_takes_its_losses_over_any_batch(head: str, loss: str) -> None:
    made = make_head(settings(head, loss))
    raw, expert = draw(3, 4, made.width), draw(3, 4, 2, seed=1).tanh()
    value = made.loss(raw, expert)
    assert value.shape == (3, 4)
    torch.testing.assert_close(made.loss(raw[1], expert[1]), value[1])
    for action in (made.mode(raw), made.sample(raw), made.spread(raw)):
        assert action.shape == (3, 4, 2)


def test_what_no_recipe_may_ask_for() -> None:
    good = settings("gaussian", "kl")
    with pytest.raises(
        UnknownName, match=r"unknown head in \[policy\]: 'gauss'; known: discrete, gaussian, mixture, point"
    ):
        replace(good, head="gauss").check("[policy]")
    with pytest.raises(UnknownName, match=r"loss of the gaussian head in x: 'mse'; known: .*mse is a loss of: point\."):
        replace(good, loss="mse").check("x")
    with pytest.raises(UnknownName, match="known: huber, mse, p_norm. js is a loss of: gaussian, mixture, discrete"):
        replace(good, head="point", loss="js").check("x")
    wrong = {"action_dim": 0, "p": 0.5, "components": 0, "bins": 1, "loss_samples": 8}
    for key, value in (wrong | {"huber_delta": 0.0, "expert_std": -1.0, "min_std": math.inf}).items():
        with pytest.raises(RecipeError, match=f"x {key} = .*must be"):
            replace(good, **{key: value}).check("x")
    for head in ("gaussian", "mixture"):
        with pytest.raises(RecipeError, match=r"min_std = 0.01: .*give min_std = 0.05, the expert_std, or more"):
            replace(good, head=head, loss="chi2", min_std=0.01).check("x")
    replace(good, head="discrete", loss="chi2", min_std=0.01).check("x")


# What the losses are.
def test_the_point_head_measures_with_the_norms() -> None:
    raw, expert = draw(5, 2), draw(5, 2, seed=1)
    away = (raw - expert).abs()
    for loss, expected in (("mse", away.square().mean(-1)), ("p_norm", away.pow(3).sum(-1).pow(1 / 3))):
        torch.testing.assert_close(make_head(settings("point", loss, p=3.0)).loss(raw, expert), expected)
    huber = nn.functional.huber_loss(raw, expert, reduction="none", delta=0.2).sum(-1)
    torch.testing.assert_close(make_head(settings("point", "huber", huber_delta=0.2)).loss(raw, expert), huber)


def gaussian_of(raw: Tensor) -> tuple[Tensor, Tensor]:
    return raw[:, :2], 0.05 + torch.log1p(raw[:, 2:].exp())


@pytest.mark.parametrize("loss", LOSSES["gaussian"])
def test_the_losses_of_the_gaussian_head(loss: str) -> None:
    raw, expert = draw(6, 4), draw(6, 2, seed=1) * 0.3
    value = make_head(settings("gaussian", loss, expert_std=0.04, loss_samples=2048)).loss(raw, expert)
    mean, std = gaussian_of(raw)
    of = torch.full_like(mean, 0.04)
    if loss == "nll":
        expected = -distributions.Normal(mean, std).log_prob(expert).sum(-1)
    elif loss in ("js", "tv"):
        lines = [gaussian_f_divergence(*(x[:, i, None] for x in (expert, of, mean, std)), kind=loss) for i in range(2)]
        expected = lines[0] + lines[1]
        assert (expected >= gaussian_f_divergence(expert, of, mean, std, kind=loss)).all()
    else:
        expected = gaussian_f_divergence(expert, of, mean, std, kind=loss)
    torch.testing.assert_close(value.expm1() if loss == "chi2" else value, expected)


def mixture_of(raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Logits, then for each Gaussian its mean and its raw std."""
    rest = raw[:, 3:].reshape(-1, 3, 4)
    return raw[:, :3], rest[..., :2], 0.05 + torch.log1p(rest[..., 2:].exp())


@pytest.mark.parametrize("loss", LOSSES["mixture"])
def test_the_losses_of_the_mixture_head(loss: str) -> None:
    raw, expert = draw(6, 15), draw(6, 2, seed=1) * 0.3
    value = make_head(settings("mixture", loss, components=3, loss_samples=512)).loss(raw, expert)
    logits, means, stds = mixture_of(raw)
    normals = distributions.Independent(distributions.Normal(means, stds), 1)
    if loss == "nll":
        family = distributions.MixtureSameFamily(distributions.Categorical(logits=logits), normals)
        torch.testing.assert_close(value, -family.log_prob(expert))
        return
    of = torch.full_like(expert, 0.05)
    expected = monte_carlo_f_divergence(expert, of, logits, means, stds, kind=loss, samples=512)
    torch.testing.assert_close(value.expm1() if loss == "chi2" else value, expected)


@pytest.mark.parametrize("loss", KINDS)
def test_the_losses_of_the_discrete_head_are_those_of_all_pairs_of_bins(loss: str) -> None:
    """Whole actions are enumerated: 5 x 5 of them."""
    raw, expert = draw(4, 10), draw(4, 2, seed=1) * 0.5
    value = make_head(settings("discrete", loss, bins=5, expert_std=0.3)).loss(raw, expert)
    edges = torch.tensor([-math.inf, -0.6, -0.2, 0.2, 0.6, math.inf], dtype=torch.float64)
    cdf = distributions.Normal(expert[..., None], 0.3).cdf(edges)
    p, q = cdf.diff(dim=-1), raw.reshape(4, 2, 5).softmax(-1)
    whole_p, whole_q = ((x[:, 0, :, None] * x[:, 1, None, :]).flatten(1) for x in (p, q))
    whole = f_divergence(whole_p, whole_q.log(), kind=loss)
    if loss in ("js", "tv"):
        torch.testing.assert_close(value, f_divergence(p, q.log(), kind=loss).sum(-1))
        assert (value >= whole).all()
    else:
        torch.testing.assert_close(value.expm1() if loss == "chi2" else value, whole)


def test_nll_of_the_discrete_head_is_of_the_bin_that_holds_the_action() -> None:
    raw = draw(1, 5).expand(4, 5)
    expert = torch.tensor([[-3.0], [-0.5], [0.59], [1.0]], dtype=torch.float64)
    value = make_head(settings("discrete", "nll", action_dim=1, bins=5)).loss(raw, expert)
    torch.testing.assert_close(value, -raw[0].log_softmax(-1)[[0, 1, 3, 4]])


def test_a_binned_gaussian_is_exact_in_its_tails() -> None:
    """Against differences of scipy's distribution functions, from the side on which they have digits."""
    mean = np.array([[-1.3, -0.98, 0.0, 0.61, 1.0]])
    edges = np.linspace(-1, 1, 52)
    edges[0], edges[-1] = -np.inf, np.inf
    z = (edges - mean[..., None]) / 0.05
    p = np.where(z[..., 1:] <= 0, np.diff(ndtr(z), axis=-1), -np.diff(ndtr(-z), axis=-1))
    log_p = log_normal_bins(torch.from_numpy(mean), 0.05, 51)
    seen = p > 1e-280
    np.testing.assert_allclose(log_p.numpy()[seen], np.log(p[seen]), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(log_p.exp().sum(-1), torch.ones(1, 5, dtype=torch.float64))
    single = log_normal_bins(torch.from_numpy(mean).float(), 0.05, 51)
    assert torch.isfinite(single).all()
    torch.testing.assert_close(single.double(), log_p, rtol=1e-4, atol=1e-4)


# What is executed.
@pytest.mark.parametrize("head", STOCHASTIC)
def test_samples_have_the_spread_and_follow_torchs_seed(head: str) -> None:
    made = make_head(settings(head, "nll", components=3, bins=7))
    raw = draw(1, made.width).expand(40_000, made.width)
    torch.manual_seed(0)
    samples = made.sample(raw)
    torch.testing.assert_close(samples.std(0), made.spread(raw[0]), rtol=0.03, atol=0)
    torch.manual_seed(0)
    assert torch.equal(made.sample(raw), samples)


def test_modes() -> None:
    point, gaussian = make_head(settings("point", "mse")), make_head(settings("gaussian", "nll"))
    raw = draw(3, 4)
    assert torch.equal(point.mode(raw[:, :2]), raw[:, :2])
    assert torch.equal(point.spread(raw[:, :2]), torch.zeros(3, 2, dtype=torch.float64))
    assert torch.equal(gaussian.mode(raw), raw[:, :2])
    mixture = make_head(settings("mixture", "nll", components=3))
    raw = draw(1, 15)
    raw[0, :3] = torch.tensor([0.0, 2.0, 1.0])
    assert torch.equal(mixture.mode(raw), mixture_of(raw)[1][:, 1])
    discrete = make_head(settings("discrete", "nll", action_dim=1, bins=4))  # centres -0.75, -0.25, 0.25, 0.75
    q = torch.tensor([[0.4, 0.2, 0.1, 0.3], [0.1, 0.5, 0.3, 0.1]])
    expected = torch.tensor([[(0.4 * -0.75 + 0.2 * -0.25) / 0.6], [(0.1 * -0.75 + 0.5 * -0.25 + 0.3 * 0.25) / 0.9]])
    torch.testing.assert_close(discrete.mode(q.log()), expected)


# What training finds.
@pytest.mark.parametrize(("head", "loss"), ALL)
def test_gradients_are_finite_everywhere(head: str, loss: str) -> None:
    made = make_head(settings(head, loss, action_dim=7))
    for scale in (0.0, 1.0, 30.0, 1000.0):
        raw = (draw(8, made.width).float() * scale).requires_grad_()
        expert = torch.cat([draw(6, 7, seed=1).float().tanh(), torch.ones(1, 7), -3 * torch.ones(1, 7)])
        value = made.loss(raw, expert)
        assert torch.isfinite(value).all()
        (gradient,) = torch.autograd.grad(value.sum(), raw)
        assert torch.isfinite(gradient).all()


def fit(made: HeadSettings, expert, steps: int) -> nn.Module:
    """A small network descends the loss on (x, u*) pairs that `expert` draws."""
    torch.manual_seed(0)
    head = make_head(made)
    net = nn.Sequential(nn.Linear(1, 32), nn.Tanh(), nn.Linear(32, head.width))
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        x = torch.rand(128, 1) * 2 - 1
        loss = head.loss(net(x), expert(x)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return net


def one_way(x: Tensor) -> Tensor:
    return torch.cat([0.6 * torch.sin(2 * x), -0.5 * x], dim=-1)


@pytest.mark.parametrize(("head", "loss"), ALL)
def test_every_loss_finds_the_action_of_a_noisy_expert(head: str, loss: str) -> None:
    made = settings(head, loss, components=2, loss_samples=32)
    net = fit(made, lambda x: one_way(x) + 0.05 * torch.randn(len(x), 2), 500)
    x = torch.linspace(-0.95, 0.95, 50)[:, None]
    with torch.no_grad():
        away = make_head(made).mode(net(x)) - one_way(x)
        spread = make_head(made).spread(net(x)).mean()
    # reverse_kl has the least to say about bins that have lost their probability: after 1500 steps it is at 0.06.
    assert away.square().mean().sqrt() < (0.1 if (head, loss) == ("discrete", "reverse_kl") else 0.05)
    if head != "discrete" and loss in (
        "nll",
        "kl",
    ):  # the expert's noise, and for kl also the Gaussian around each action
        noise = math.hypot(0.05, 0.05 if loss == "kl" else 0.0)
        assert float(spread) == pytest.approx(noise, abs=0.02)


def either_way(x: Tensor) -> Tensor:
    """0.5 or -0.5, by a coin."""
    return torch.where(torch.rand_like(x) < 0.5, 0.5, -0.5) + 0.05 * torch.randn_like(x)


@pytest.mark.parametrize(
    ("head", "loss"), [("mixture", "nll"), ("mixture", "kl"), ("discrete", "nll"), ("discrete", "kl")]
)
def test_an_expert_of_two_minds_is_imitated(head: str, loss: str) -> None:
    made = settings(head, loss, action_dim=1)
    net = fit(made, either_way, 500)
    with torch.no_grad():
        raw = net(torch.zeros(4000, 1))
        samples = make_head(made).sample(raw)[:, 0]
        mode = make_head(made).mode(raw)[0]
    assert ((samples.abs() - 0.5).abs() < 0.25).float().mean() > 0.95
    assert 0.35 < (samples > 0).float().mean() < 0.65
    assert (mode.abs() - 0.5).abs() < 0.1


@pytest.mark.parametrize(("head", "loss"), [("point", "mse"), ("gaussian", "nll")])
def test_an_expert_of_two_minds_is_averaged(head: str, loss: str) -> None:
    """What the other heads are for: the mean of two good actions is a bad one."""
    made = settings(head, loss, action_dim=1)
    net = fit(made, either_way, 500)
    with torch.no_grad():
        raw = net(torch.zeros(1, 1))
    assert make_head(made).mode(raw).abs() < 0.2
