from itertools import product

import numpy as np
import pytest

from lfd.bench.compounding import CompoundingBench, bench_compounding, plot, rows_of, slope
from lfd.bench.stretched_lift import Setting, Side, Stretched
from lfd.bench.tightrope import (
    CLIMB,
    EXPERT,
    LEAN,
    OFF,
    ROPE,
    WALK,
    clone,
    dagger,
    error_rate,
    expected_cost,
    expected_labels,
    learn,
    mixture,
    visits,
)


def is_off(action: int, gust: bool, off: bool) -> bool:
    """Whether the walker is off the rope after a step, by the rules in words."""
    if off:
        return action != CLIMB
    return action != (LEAN if gust else WALK)


def cost_by_enumeration(on_rope: int, off_rope: int, epsilon: float, horizon: int) -> float:
    """The expected cost of a policy that sees only the place: every sequence of gusts, with its probability."""
    total = 0.0
    for sequence in product([False, True], repeat=horizon):
        chance, off, cost = 1.0, False, 0
        for gust in sequence:
            chance *= epsilon if gust else 1 - epsilon
            off = is_off(off_rope if off else on_rope, gust, off)
            cost += off
        total += chance * cost
    return total


@pytest.mark.parametrize("on_rope", [WALK, LEAN, CLIMB])
@pytest.mark.parametrize("off_rope", [WALK, CLIMB])
def test_costs_are_those_of_all_sequences_of_gusts(on_rope, off_rope) -> None:
    for epsilon, horizon in product([0.1, 0.6], [1, 2, 9]):
        policy = mixture(np.eye(3)[[on_rope, off_rope]], 0.0)
        wanted = cost_by_enumeration(on_rope, off_rope, epsilon, horizon)
        assert expected_cost(policy, epsilon, horizon) == pytest.approx(wanted, rel=1e-12)


def test_costs_in_closed_form() -> None:
    epsilon, horizon = 0.02, 300
    keep = 1 - epsilon
    fallen = mixture(clone(epsilon, horizon), 0.0)
    wanted = horizon - keep * (1 - keep**horizon) / epsilon  # sum over t of 1 - keep^t
    assert expected_cost(fallen, epsilon, horizon) == pytest.approx(wanted, rel=1e-10)
    returns = mixture(dagger(epsilon, horizon, (1.0, 0.0)), 0.0)
    share = epsilon / (1 + epsilon)  # off_t+1 = epsilon (1 - off_t)
    wanted = share * (horizon - sum((-epsilon) ** t for t in range(1, horizon + 1)))
    assert expected_cost(returns, epsilon, horizon) == pytest.approx(wanted, rel=1e-10)
    assert expected_cost(EXPERT, epsilon, horizon) == 0.0


def test_a_mixture_costs_what_walks_with_a_coin_cost() -> None:
    epsilon, beta, horizon, walkers = 0.1, 0.4, 20, 20_000
    rng = np.random.default_rng(0)
    costs = np.zeros(walkers)
    for walker in range(walkers):
        off = False
        for gust, coin in zip(rng.random(horizon) < epsilon, rng.random(horizon) < beta, strict=True):
            expert = CLIMB if off else LEAN if gust else WALK
            off = is_off(expert if coin else WALK, bool(gust), off)
            costs[walker] += off
    exact = expected_cost(mixture(clone(epsilon, horizon), beta), epsilon, horizon)
    assert abs(costs.mean() - exact) < 4 * costs.std() / np.sqrt(walkers)


def test_the_learner_is_the_best_of_its_class() -> None:
    """Fewest wrong labels among all 9 policies that see the place, in a place that has labels."""
    labels = np.array([[9.0, 1.0, 0.0], [0.0, 0.0, 0.5]])
    losses = {pair: labels.sum() - labels[ROPE, pair[0]] - labels[OFF, pair[1]] for pair in product(range(3), repeat=2)}
    assert tuple(learn(labels).argmax(axis=1)) == min(losses, key=lambda pair: losses[pair]) == (WALK, CLIMB)


def test_cloning_and_dagger_err_alike_on_the_rope_and_differ_off_it() -> None:
    epsilon, horizon = 0.01, 50
    cloned, aggregated = clone(epsilon, horizon), dagger(epsilon, horizon, (1.0, 0.0))
    assert error_rate(cloned, epsilon) == error_rate(aggregated, epsilon) == pytest.approx(epsilon)
    assert (cloned.argmax(axis=1) == [WALK, WALK]).all()
    assert (aggregated.argmax(axis=1) == [WALK, CLIMB]).all()
    assert (dagger(epsilon, horizon, (1.0, 1.0)) == cloned).all()  # the expert alone shows nothing new


def test_data_of_real_walks_lead_to_the_same_policies() -> None:
    """Labels counted in sampled episodes, of the expert and of its clone, instead of their expectations."""
    epsilon, horizon, rng = 0.05, 40, np.random.default_rng(1)
    counted = np.zeros((2, 2, 3))
    for learner in (0, 1):
        for _ in range(200):
            off = False
            for gust in rng.random(horizon) < epsilon:
                label = CLIMB if off else LEAN if gust else WALK
                counted[learner, int(off), label] += 1
                off = is_off(WALK if learner else label, bool(gust), off)
    assert (learn(counted[0]) == clone(epsilon, horizon)).all()
    assert (learn(counted.sum(axis=0)) == dagger(epsilon, horizon, (1.0, 0.0))).all()
    exact = expected_labels(mixture(clone(epsilon, horizon), 0.0), epsilon, horizon)
    np.testing.assert_allclose(
        counted[1] / 200, exact, atol=4 * horizon / 2 / np.sqrt(200)
    )  # no number within [0, T] spreads more than T / 2


def test_probabilities_stay_probabilities() -> None:
    seen = visits(mixture(clone(0.3, 5), 0.5), 0.3, 50)
    np.testing.assert_allclose(seen.sum(axis=1), 1.0)
    assert seen.shape == (51, 2)


def test_slopes_are_powers() -> None:
    lengths = [10, 20, 50, 100]
    assert slope(lengths, [3 * length**1.5 for length in lengths]) == pytest.approx(1.5)
    assert np.isnan(slope(lengths, [0.0, 1.0, 2.0, 3.0]))


def test_on_the_tightrope_the_slopes_are_two_and_one() -> None:
    horizons, epsilon = (10, 30, 100, 300, 1000), 1e-5
    policies = [[make(horizon) for horizon in horizons] for make in (
        lambda horizon: clone(epsilon, horizon), lambda horizon: dagger(epsilon, horizon, (1.0, 0.0)),
    )]  # fmt: skip
    for learners, power, factor in zip(policies, (2, 1), (epsilon / 2, epsilon), strict=True):
        costs = [expected_cost(mixture(p, 0.0), epsilon, T) for p, T in zip(learners, horizons, strict=True)]
        assert slope(horizons, costs) == pytest.approx(power, abs=0.03)
        assert costs[-1] == pytest.approx(factor * horizons[-1] ** power, rel=0.01)


def test_the_page_and_the_picture(tmp_path) -> None:
    rows = tuple(
        Stretched(speed=speed, length=length, episodes=40, cloned=side, dagger=side)
        for speed, length in ((1.0, 32.0), (0.5, 46.0))
        for side in [Side(labels=500, costs=(40.0, 20.0), solved=18)]
    )
    measured = CompoundingBench(
        epsilon=1e-4, horizons=(10, 100), cloned=(0.005, 0.5), dagger=(0.001, 0.01), slopes={"x": 2.0}, lift=rows
    )
    said = rows_of(measured)
    assert said["tightrope, T = 100"] == "expected cost 0.5 cloned, 0.01 with DAgger"
    assert said["Lift, expert at 50% of its speed: 46 steps, 500 labels"].startswith(
        "cloned 30.0 errors (seeds 20.0 to 40.0), 18 of 40 solved; DAgger 30.0"
    )
    plot(measured, tmp_path / "compounding.png")
    assert (tmp_path / "compounding.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_lift_is_measured_at_equal_labels() -> None:
    setting = Setting(robot="panda", control_hz=20, demonstrations=4, episodes=3, gradient_steps=100)
    measured = bench_compounding(
        epsilon=1e-4, horizons=(10, 100), rounds=2, lift=setting, speeds=(1.0, 0.5), seeds=(0,)
    )
    fast, slow = measured.lift
    assert slow.length > 1.2 * fast.length
    for row in measured.lift:
        assert 0.9 * row.cloned.labels < row.dagger.labels <= row.cloned.labels
        assert row.cloned.labels == pytest.approx(4 * row.length)
        assert all(0 <= side.cost <= 2 * row.length + 1 for side in (row.cloned, row.dagger))
        assert row.episodes == 3
