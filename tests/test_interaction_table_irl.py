import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from lfd.cli import main
from lfd.core.errors import InputError
from lfd.interaction.choices_irl import Choices, learn_theta, of_people
from lfd.interaction.person_reward import LEARNABLE, PersonReward, load_person_reward, save_person_reward, theta_of
from lfd.interaction.table_irl import FEATURES, WIDE, choices_of
from lfd.interaction.table_people import VELOCITIES, BoltzmannHand, choices_now
from lfd.interaction.table_robots import ReacherOptions
from lfd.loops.learning_people import choices_in, predicted
from lfd.record.episode_file import McapRecorder, Origin, read_episode
from lfd.worlds.rollout import episode_rng, rollout
from lfd.worlds.shared_table import HAND_HIGH, HAND_LOW, SharedTableWorld, seen_table
from lfd.worlds.shared_table_guard import GOAL_SPEED

SHY = 20.0
"""Yielding of people between those that robots know of."""


class ShyHand(BoltzmannHand):
    """People who all yield so much."""

    def draw(self, rng):
        return np.array([float(rng.integers(3)), SHY])


class Chaser:
    """A robot that goes for the hand, so that people have something to yield to."""

    name = "chaser"

    def reset(self, rng):
        self._rng = rng

    def act(self, observation):
        from lfd.core.protocols import Decision

        table = seen_table(observation)
        way = np.append(table.hand, 0.95) - table.goal
        return Decision(np.clip(way + 0.1 * self._rng.normal(size=3), -GOAL_SPEED, GOAL_SPEED))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Recordings of shy people."""
    folder, world = tmp_path_factory.mktemp("shy"), SharedTableWorld(ShyHand("random", 0.3), 5)
    for index in range(14):
        origin = Origin(stage="eval", policy="chaser", seed=1000, index=index, recipe={})
        recorder = McapRecorder(folder / f"episode_{index:06d}.mcap", origin, keep_failures=True)
        rollout(world, Chaser(), [recorder], episode_rng("eval", 1000, index), horizon=25, hold_steps=30)
    return folder


@pytest.fixture(scope="module")
def people(recorded):
    return [choices_of(read_episode(path)) for path in sorted(recorded.iterdir())]


def test_an_episode_is_as_likely_as_its_choices_whichever_cube_the_person_went_for(recorded, people) -> None:
    """Against `choices_now`, step by step, with each cube."""
    episode, totals = read_episode(min(recorded.iterdir())), np.zeros(3)
    rows = [{name: values[t] for name, values in episode.observations.items()} for t in range(len(episode) + 1)]
    for before, after, action in zip(rows, rows[1:], episode.actions, strict=False):
        now, then = seen_table(before), seen_table(after)
        ends = np.clip(now.hand + 0.2 * VELOCITIES.numpy(), HAND_LOW, HAND_HIGH)
        (there,) = np.nonzero(np.linalg.norm(ends - then.hand, axis=1) < 1e-6)
        if len(there) == 1:
            theta = torch.tensor([[0.0, 7.0], [1.0, 7.0], [2.0, 7.0]], dtype=torch.float64)
            totals += choices_now(now, theta, action, 0.3)[:, there[0]].numpy()
    assert of_people(np.array([7.0]), people[:1], 0.3)[0] == pytest.approx(np.log(np.exp(totals).mean()), abs=1e-8)


def test_slope_and_curvature_of_a_mixture_are_those_of_finite_differences() -> None:
    """Of two weights and short episodes, which leave the intent open."""
    rng = np.random.default_rng(0)
    people = [
        tuple(
            Choices(rng.normal(size=(3, 4)), rng.normal(size=(3, 4, 2)), np.arange(3)) for _ in range(3)
        )
        for _ in range(4)
    ]  # fmt: skip
    theta = np.array([0.5, 1.5])
    _, slope, information = of_people(theta, people, 0.8)
    for k in range(2):
        step = 1e-5 * np.eye(2)[k]
        ends = [of_people(theta + sign * step, people, 0.8) for sign in (1.0, -1.0)]
        assert slope[k] == pytest.approx((ends[0][0] - ends[1][0]) / 2e-5, rel=1e-6)
        np.testing.assert_allclose(information[k], -(ends[0][1] - ends[1][1]) / 2e-5, rtol=1e-6, atol=1e-8)


def test_what_people_yield_is_learned_without_knowing_what_they_went_for(people) -> None:
    seen, held_out = people[:10], people[10:]
    found = learn_theta(seen, wide=np.array(WIDE), rationality=0.3)
    assert found.converged
    assert abs(found.theta[0] - SHY) < 4.0 * np.sqrt(found.covariance[0, 0])
    assert found.theta[0] > 2.0 * np.sqrt(found.covariance[0, 0])  # it tells them from those who insist
    reward = PersonReward(
        type="insists", features=FEATURES, weights=tuple(found.theta.tolist()), spread=(1.0,), rationality=0.3,
        choices=1, log_likelihood=0.0,
    )  # fmt: skip
    judged = predicted(held_out, reward)
    best = of_people(np.array([SHY]), held_out, 0.3)[0] / choices_in(held_out)
    assert judged["learned"] > judged["default"]
    assert judged["learned"] > judged["chance"] + 0.3
    assert judged["learned"] > best - 0.03


@pytest.mark.slow
def test_the_commands_learn_from_a_table_and_robots_believe_it(recorded, tmp_path, capfd) -> None:
    out, met = tmp_path / "shy", tmp_path / "met"
    assert main(["irl", "people", "--dataset", str(recorded), "--type", "yields", "--out", str(out), "--json"]) == 0
    assert len(json.loads(capfd.readouterr().out)["reward"]["weights"]) == 1
    reward = load_person_reward(out)
    options = ReacherOptions(kind="passive", learned=theta_of([reward], 0.3))
    assert options.theta["left-yields"] == (0.0, *reward.weights)
    assert options.theta["left-insists"] == (0.0, *LEARNABLE["insists"].default)
    command = ["interact", "shared_table", "--robot-kind", "known", "--episodes", "1", "--person-reward", str(out)]
    assert main([*command, "--out", str(met)]) == 0
    recipe = json.loads((met / "manifest.json").read_text())["recipe"]["interact"]
    assert recipe["robots"][0]["learned"] == [["yields", list(reward.weights)]]


def test_a_recording_whose_hand_goes_elsewhere_is_refused(recorded, tmp_path) -> None:
    episode = read_episode(min(recorded.iterdir()))
    moved = episode.observations["hand_pos"] + 0.01 * (np.arange(len(episode) + 1) > 3)[:, None]
    episode = replace(episode, observations={**episode.observations, "hand_pos": moved})
    with pytest.raises(InputError, match="did not choose from the velocities"):
        choices_of(episode)
    reward = PersonReward(
        type="yields", features=FEATURES, weights=(1.0,), spread=(1.0,), rationality=0.3, choices=1, log_likelihood=0.0
    )
    save_person_reward(reward, tmp_path / "r", recipe={}, parents={}, overwrite=False)
    assert load_person_reward(tmp_path / "r") == reward
