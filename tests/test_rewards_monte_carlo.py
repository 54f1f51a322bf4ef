"""Monte Carlo against the exact recursion of a finite MDP; a rollout is sampled there, or a policy acts in it."""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pytest

from lfd.core.errors import InputError, SimulationError
from lfd.core.processes import ProcessMap
from lfd.core.protocols import Decision, Observation, StepResult, World, WorldSpec, WorldState
from lfd.planning import TabularMDP
from lfd.rewards import expectations_in_worlds, feature_counts, sampled_expectations
from lfd.rewards.monte_carlo import STREAM
from lfd.worlds.rollout import OneEach
from tests.small_mdps import random_mdp, random_policy

MDP = random_mdp(3, states=4, horizon=5, discount=0.8)
POLICY = random_policy(MDP, np.random.default_rng(3))
STATIONARY = POLICY[0]


def roll(mdp: TabularMDP, policy: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    states, actions = mdp.sample(policy, 1, rng)
    return mdp.features[states[0, :-1], actions[0]]


def spoilt(rng: np.random.Generator) -> np.ndarray:
    return np.array([[1.0], [np.inf]])


def ragged(rng: np.random.Generator) -> np.ndarray:
    return np.zeros((2, rng.integers(1, 9)))


class MdpWorld:
    """A finite MDP as a world: observations are states, actions are numbers of actions."""

    def __init__(self, mdp: TabularMDP, *, breaks: bool = False):
        self._mdp, self._breaks, self._state = mdp, breaks, 0
        self._rng = np.random.default_rng()
        one = np.zeros(1)
        self.spec = WorldSpec(
            task="mdp",
            instruction="",
            robot="",
            controller="",
            control_hz=1,
            labels={"state": ("state",), "action": ("action",)},
            action_low=one,
            action_high=one + mdp.features.shape[1] - 1,
            stepper="",
        )

    def reset(self, rng: np.random.Generator) -> Observation:
        self._rng = rng
        self._state = int(rng.choice(len(self._mdp.initial), p=self._mdp.initial))
        return self._seen()

    def step(self, action: np.ndarray) -> StepResult:
        chances = self._mdp.transitions[self._state, int(action[0])]
        self._state = int(self._rng.choice(len(chances), p=chances))
        return StepResult(self._seen(), 0.0, False, failure="it fell over" if self._breaks else "")

    def sim_state(self) -> np.ndarray:
        return np.array([float(self._state)])

    def pictures(self) -> Mapping[str, np.ndarray]:
        return {}

    def get_state(self) -> WorldState:
        return WorldState(model_xml="", sim=self.sim_state(), memory={})

    def set_state(self, state: WorldState) -> Observation:
        self._state = int(state.sim[0])
        return self._seen()

    def _seen(self) -> Observation:
        return {"state": self.sim_state()}


class Draws:
    """Draws actions from the rows of a stationary policy."""

    name = "draws"

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def act(self, observation: Observation) -> Decision:
        chances = STATIONARY[int(observation["state"][0])]
        return Decision(np.array([float(self._rng.choice(len(chances), p=chances))]))


def phi(observation: Observation, action: np.ndarray) -> np.ndarray:
    return MDP.features[int(observation["state"][0]), int(action[0])]


def in_worlds(worlds: int, count: int):
    made: list[World] = [MdpWorld(MDP) for _ in range(worlds)]
    policy = OneEach([Draws() for _ in made])
    return expectations_in_worlds(made, policy, phi, count, discount=0.8, seed=1, horizon=5, hold_steps=1)


def test_the_mean_of_sampled_rollouts_is_the_exact_mu_within_its_standard_error() -> None:
    found = sampled_expectations(partial(roll, MDP, POLICY), 2000, discount=0.8, seed=0, units=ProcessMap(1))
    error = found.mean - MDP.feature_expectation(POLICY)
    assert (np.abs(error) < 4 * found.standard_error).all()
    assert (found.standard_error < 0.05).all()
    assert found.trajectories == 2000


def test_standard_errors_are_the_spread_of_estimates() -> None:
    one = partial(roll, MDP, POLICY)
    many = [sampled_expectations(one, 20, discount=0.8, seed=seed, units=ProcessMap(1)) for seed in range(100)]
    spread = np.std([found.mean for found in many], axis=0, ddof=1)
    said = np.sqrt(np.mean([found.standard_error**2 for found in many], axis=0))
    np.testing.assert_allclose(said, spread, rtol=0.3)


def test_a_rollout_depends_on_seed_and_index_alone() -> None:
    one = partial(roll, MDP, POLICY)
    found = sampled_expectations(one, 7, discount=0.8, seed=5, units=ProcessMap(1))
    by_hand = [feature_counts(one(np.random.default_rng([STREAM, 5, i])), discount=0.8) for i in range(7)]
    np.testing.assert_array_equal(found.mean, np.mean(by_hand, axis=0))


def test_a_policy_in_worlds_has_the_exact_mu_of_its_mdp() -> None:
    found = in_worlds(1, 2000)
    assert (np.abs(found.mean - MDP.feature_expectation(STATIONARY)) < 4 * found.standard_error).all()


def test_one_and_three_worlds_give_the_same_bits() -> None:
    one, three = in_worlds(1, 50), in_worlds(3, 50)
    np.testing.assert_array_equal(one.mean, three.mean)
    np.testing.assert_array_equal(one.standard_error, three.standard_error)


def test_bad_rollouts_are_named() -> None:
    with pytest.raises(InputError, match=r"rollout 0: phi\[1, 0\] is inf"):
        sampled_expectations(spoilt, 2, discount=1.0, seed=0, units=ProcessMap(1))
    with pytest.raises(InputError, match=r"trajectory \d has \d features, trajectory 0 has \d"):
        sampled_expectations(ragged, 20, discount=1.0, seed=0, units=ProcessMap(1))
    with pytest.raises(InputError, match="count = 0: give at least one rollout"):
        sampled_expectations(spoilt, 0, discount=1.0, seed=0, units=ProcessMap(1))
    with pytest.raises(InputError, match="discount = 2"):
        sampled_expectations(spoilt, 1, discount=2, seed=0, units=ProcessMap(1))
    broken = [MdpWorld(MDP, breaks=True)]
    with pytest.raises(SimulationError, match="rollout 0 broke off at step 1: it fell over"):
        expectations_in_worlds(broken, OneEach([Draws()]), phi, 2, discount=1.0, seed=0, horizon=5, hold_steps=1)


def test_one_and_two_processes_give_the_same_bits() -> None:
    one = partial(roll, MDP, POLICY)
    alone, two = (sampled_expectations(one, 30, discount=0.8, seed=2, units=ProcessMap(cpus)) for cpus in (1, 2))
    np.testing.assert_array_equal(alone.mean, two.mean)
    np.testing.assert_array_equal(alone.standard_error, two.standard_error)


@pytest.mark.slow
def test_ray_gives_the_same_bits() -> None:
    from lfd.cluster import connect

    one = partial(roll, MDP, POLICY)
    alone = sampled_expectations(one, 30, discount=0.8, seed=2, units=ProcessMap(1))
    with connect("local") as cluster:
        on_ray = sampled_expectations(one, 30, discount=0.8, seed=2, units=cluster)
    np.testing.assert_array_equal(alone.mean, on_ray.mean)
    np.testing.assert_array_equal(alone.standard_error, on_ray.standard_error)
