from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Decision
from lfd.experts.noise import NoisyPolicy
from lfd.run.control import SCHEDULES, MixturePolicy, beta_schedule, label_of
from lfd.worlds.rollout import OneEach, Start, rollouts
from tests.point_mass import SPEC, PointExpert, PointLearner, PointMass

NAMES = SPEC.labels["action"]


def mixture(beta: float, per: str, worlds: int = 1, noise: float = 0.3) -> MixturePolicy:
    experts, learners = ([make() for _ in range(worlds)] for make in (PointExpert, lambda: PointLearner(noise=noise)))
    return MixturePolicy(OneEach(experts), OneEach(learners), beta, per=per, names=NAMES)


def decisions(beta: float, per: str, *, steps: int, seed: int) -> list[Decision]:
    """What a mixture decides in some states, which do not depend on it."""
    policy = mixture(beta, per)
    policy.reset(0, np.random.default_rng(seed))
    states = np.random.default_rng([seed, 1]).uniform(-1, 1, (steps, 2))
    return [policy.act([0], [{"position": x}])[0] for x in states]


def test_schedules_in_closed_form() -> None:
    assert beta_schedule("first", 4, rate=0.5) == (1.0, 0.0, 0.0, 0.0)
    assert beta_schedule("exponential", 4, rate=0.5) == (1.0, 0.5, 0.25, 0.125)
    assert beta_schedule("linear", 5, rate=0.5) == (1.0, 0.75, 0.5, 0.25, 0.0)


@given(st.sampled_from(sorted(SCHEDULES)), st.integers(1, 30), st.floats(0, 1))
def test_every_schedule_begins_with_the_expert_and_never_rises(kind, rounds, rate) -> None:
    betas = beta_schedule(kind, rounds, rate=rate)
    assert len(betas) == rounds
    assert betas[0] == 1.0
    assert all(0.0 <= later <= earlier for earlier, later in pairwise(betas))


def test_mistakes_in_a_schedule() -> None:
    with pytest.raises(UnknownName, match="unknown beta schedule 'lin'; known: exponential, first, linear"):
        beta_schedule("lin", 3, rate=0.5)
    with pytest.raises(InputError, match="rounds = 0: DAgger needs at least 1 round"):
        beta_schedule("first", 0, rate=0.5)
    with pytest.raises(InputError, match=r"rate = 1.5: beta is a probability"):
        beta_schedule("exponential", 3, rate=1.5)


@pytest.mark.parametrize("beta", [0.0, 0.2, 0.7, 1.0])
def test_the_share_of_the_experts_steps_is_beta(beta) -> None:
    steps = 4000
    share = np.mean([decision.intervention for decision in decisions(beta, "step", steps=steps, seed=1)])
    assert abs(share - beta) <= 4 * np.sqrt(beta * (1 - beta) / steps)


def test_the_coin_of_each_step_is_independent_of_the_last() -> None:
    acts = np.array([decision.intervention for decision in decisions(0.5, "step", steps=4000, seed=2)])
    assert abs(np.mean(acts[1:] == acts[:-1]) - 0.5) <= 4 * 0.5 / np.sqrt(len(acts))


def test_one_coin_for_an_episode() -> None:
    episodes = [decisions(0.3, "episode", steps=3, seed=seed) for seed in range(600)]
    firsts = [steps[0].intervention for steps in episodes]
    assert all(len({step.intervention for step in steps}) == 1 for steps in episodes)
    assert abs(np.mean(firsts) - 0.3) <= 4 * np.sqrt(0.3 * 0.7 / len(firsts))


@pytest.mark.parametrize("per", ["step", "episode"])
def test_the_label_is_the_experts_and_the_action_one_of_the_two(per) -> None:
    states = np.random.default_rng([5, 1]).uniform(-1, 1, (200, 2))
    for state, decision in zip(states, decisions(0.5, per, steps=200, seed=5), strict=True):
        expert = PointExpert().act({"position": state}).action
        assert decision.expert_action is not None
        np.testing.assert_array_equal(decision.expert_action, expert)
        learner = list(decision.signals["policy_action"].values())
        np.testing.assert_array_equal(decision.action, expert if decision.intervention else learner)


def test_what_the_learner_does_is_independent_of_the_coin() -> None:
    runs = [decisions(beta, per, steps=50, seed=7) for beta in (0.0, 0.5, 1.0) for per in ("step", "episode")]
    proposed = [[decision.signals["policy_action"] for decision in run] for run in runs]
    assert all(each == proposed[0] for each in proposed)


def test_the_label_of_a_noisy_expert_is_what_it_meant() -> None:
    noisy = NoisyPolicy(PointExpert(), ("x", "y"), scale=0.5)
    policy = MixturePolicy(OneEach([noisy]), OneEach([PointLearner()]), 1.0, per="step")
    policy.reset(0, np.random.default_rng(3))
    (decision,) = policy.act([0], [{"position": np.array([0.03, -0.02])}])
    np.testing.assert_allclose(label_of(decision), [-0.3, 0.2])
    assert decision.action[0] != label_of(decision)[0]
    assert decision.signals == {}


def test_a_policy_that_says_no_label_means_its_action() -> None:
    action = np.ones(2)
    assert label_of(Decision(action)) is action


def test_an_episode_is_the_same_however_many_worlds_run() -> None:
    alone, together = (outcomes(worlds) for worlds in (1, 3))
    assert alone == together


def outcomes(worlds: int) -> dict:
    starts: Iterator[Start] = (Start(index=index, rng=np.random.default_rng([9, index])) for index in range(6))
    places = [PointMass() for _ in range(worlds)]
    ended = rollouts(places, mixture(0.5, "step", worlds), lambda: next(starts, None), horizon=40, hold_steps=3)
    return {start.index: outcome for start, outcome in ended}


def test_mistakes_in_a_mixture() -> None:
    with pytest.raises(InputError, match=r"beta = 1.2: it is the probability that the expert acts"):
        mixture(1.2, "step")
    with pytest.raises(UnknownName, match="unknown length of a coin 'round'; known: episode, step"):
        mixture(0.5, "round")
