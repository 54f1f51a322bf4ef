import numpy as np
import pytest

from lfd import make_world
from lfd.experts.lift import LiftExpert
from lfd.experts.noise import NoisyPolicy
from lfd.experts.registry import make_expert
from lfd.run.wilson import wilson_interval
from lfd.worlds.rollout import episode_rng, rollout
from tests.expert_trials import Meddled, check_same_action, pushed, successes


@pytest.mark.slow
def test_lift_succeeds_from_at_least_98_percent_of_200_starts(lift_world) -> None:
    expert = make_expert(lift_world.spec)
    solved = successes(lift_world, expert, 41, 200, 200)
    assert solved >= 196, wilson_interval(solved, 200)


def test_the_expert_recovers_from_states_that_it_would_not_have_reached(lift_world) -> None:
    """It acts from the present state alone: half a second of random actions in between do no harm."""
    expert = make_expert(lift_world.spec)
    assert successes(lift_world, Meddled(expert, pushed(lift_world, 12)), 42, 10) >= 9


def test_the_same_observation_gives_the_same_action(lift_world) -> None:
    check_same_action(lift_world, lambda: LiftExpert(lift_world.spec), 30)


def test_noise_is_applied_and_the_label_stays_clean(lift_world) -> None:
    expert, noisy = (
        make_expert(lift_world.spec),
        NoisyPolicy(make_expert(lift_world.spec), lift_world.spec.labels["action"], scale=0.3),
    )
    seen = lift_world.reset(np.random.default_rng(1))
    noisy.reset(np.random.default_rng(2))
    meant = expert.act(seen).action
    decisions = [noisy.act(seen) for _ in range(2000)]
    for decision in decisions:
        np.testing.assert_array_equal(decision.expert_action, meant)
        assert decision.action[-1] == meant[-1]
    away = np.array([decision.action - meant for decision in decisions])[
        :, 1
    ]  # unclipped: the expert hardly moves in y
    assert abs(meant[1]) < 0.2
    assert away.std() == pytest.approx(0.3, rel=0.15)
    assert np.corrcoef(away[:-1], away[1:])[0, 1] == pytest.approx(0.8, abs=0.08)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "horizon"), [("ur5e", 200), ("iiwa", 200), ("kinova3", 200), ("sawyer", 200), ("jaco", 300)]
)
def test_the_same_expert_lifts_with_every_arm(robot, horizon) -> None:
    world = make_world("Lift", robot, 20)
    expert = LiftExpert(world.spec)
    outcomes = [
        rollout(world, expert, [], episode_rng("eval", 43, i), horizon=horizon, hold_steps=10) for i in range(20)
    ]
    assert sum(outcome.success for outcome in outcomes) >= 19
