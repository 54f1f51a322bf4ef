import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from lfd.cli import main
from lfd.core.errors import InputError
from lfd.interaction.choices_irl import Choices, learn_theta, of_people
from lfd.interaction.driving_irl import FEATURES, WIDE, choices_of
from lfd.interaction.driving_model import TYPES
from lfd.interaction.driving_people import BoltzmannDriver, choices_now
from lfd.interaction.driving_robots import DriverOptions, InteractiveDriver
from lfd.interaction.person_reward import FILE, PersonReward, load_person_reward, save_person_reward, theta_of
from lfd.loops.learning_people import choices_in, predicted
from lfd.record.episode_file import McapRecorder, Origin, read_episode
from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, DrivingWorld, load_scene, seen_cars
from lfd.worlds.rollout import episode_rng, rollout

MERGE, CROSSING = load_scene("merge"), load_scene("crossing")
HASTY = np.array([0.3, 0.8, 5.0, 15.0])
"""People unlike the aggressive ones that robots know of: they mind their speed, and effort, more than who is ahead."""


class HastyDriver(BoltzmannDriver):
    """People whose weights are about those."""

    def draw(self, rng):
        return HASTY * np.exp(0.1 * rng.normal(size=len(HASTY)))


@dataclass
class Wanderer:
    """A robot that leans in and out, so that people have something to answer to."""

    name: str = "wanderer"

    def reset(self, rng):
        self._rng = rng

    def act(self, observation):
        from lfd.core.protocols import Decision

        robot, _ = seen_cars(observation)
        aim = np.array([self._rng.normal(), 0.03 * self._rng.normal() - 0.03 * robot.yaw])
        return Decision(np.clip(aim, ACTION_LOW, ACTION_HIGH))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Recordings of hasty people."""
    folder = tmp_path_factory.mktemp("hasty")
    for index in range(14):
        world = DrivingWorld(MERGE, HastyDriver(MERGE, "aggressive", 0.3), 5)
        origin = Origin(stage="eval", policy="wanderer", seed=1000, index=index, recipe={})
        recorder = McapRecorder(folder / f"episode_{index:06d}.mcap", origin, keep_failures=True)
        rollout(world, Wanderer(), [recorder], episode_rng("eval", 1000, index), horizon=50, hold_steps=60)
    return folder


@pytest.fixture(scope="module")
def people(recorded):
    return [choices_of(MERGE, read_episode(path)) for path in sorted(recorded.iterdir())]


def reward_of(found):
    return PersonReward(
        type="aggressive", features=FEATURES, weights=tuple(found.theta.tolist()),
        spread=tuple(np.sqrt(np.diag(found.covariance)).tolist()), rationality=0.3, choices=1, log_likelihood=0.0,
    )  # fmt: skip


def test_recorded_choices_are_those_that_people_made_by_their_likelihoods(recorded, people) -> None:
    """Against `choices_now`, step by step, with other weights than any."""
    from lfd.interaction.driving_model import Situation

    episode, theta, value = read_episode(min(recorded.iterdir())), np.array([0.1, 0.4, 20.0, 10.0]), 0.0
    rows = [{name: values[t] for name, values in episode.observations.items()} for t in range(len(episode) + 1)]
    for before, after, action in zip(rows, rows[1:], episode.actions, strict=False):
        now, then = (Situation(MERGE, *seen_cars(seen)) for seen in (before, after))
        logs = choices_now(now, torch.from_numpy(theta)[None], action, 0.3)[0].numpy()
        a = (then.person.speed - now.person.speed) * 5
        value += logs[np.abs(np.linspace(-4.0, 2.5, 14) - a).argmin()]
    assert of_people(theta, people[:1], 0.3)[0] == pytest.approx(value, abs=1e-8)


def test_slope_and_curvature_are_those_of_finite_differences(people) -> None:
    few, theta, units = people[:3], np.array([0.1, 0.4, 20.0, 10.0]), np.array([0.01, 0.01, 1.0, 1.0])
    _, slope, information = of_people(theta, few, 0.3)
    for k, step in enumerate(1e-4 * units):
        ends = [of_people(theta + sign * step * np.eye(4)[k], few, 0.3) for sign in (1.0, -1.0)]
        assert slope[k] == pytest.approx((ends[0][0] - ends[1][0]) / (2.0 * step), rel=1e-5, abs=1e-6)
        np.testing.assert_allclose(information[k], -(ends[0][1] - ends[1][1]) / (2.0 * step), rtol=1e-4, atol=1e-6)


def test_learned_weights_predict_held_out_people_better_than_the_default(people) -> None:
    seen, held_out = people[:10], people[10:]
    found = learn_theta(seen, wide=np.array(WIDE), rationality=0.3)
    assert found.converged
    reward = reward_of(found)
    judged = predicted(held_out, reward)
    best = of_people(HASTY, held_out, 0.3)[0] / choices_in(held_out)
    assert judged["learned"] > judged["default"] + 0.05
    assert judged["learned"] > judged["chance"] + 0.05
    assert judged["learned"] > best - 0.03
    away = np.abs(found.theta - HASTY) / np.sqrt(np.diag(found.covariance))
    assert (away < 4.0).all()


def test_choices_of_many_people_with_one_theta_give_it_back() -> None:
    """Choices drawn from the model itself: what is learned is within its own spread of the truth."""
    rng, truth = np.random.default_rng(1000), np.array([0.1, 0.5, 30.0, 8.0])
    known, features = -rng.exponential(size=(4000, 6)), rng.exponential(size=(4000, 6, 4)) * [8.0, 4.0, 0.2, 0.2]
    logits = 0.3 * (known - features @ truth)
    p = np.exp(logits - logits.max(axis=1, keepdims=True))
    chosen = (rng.random(4000)[:, None] > (p / p.sum(axis=1, keepdims=True)).cumsum(axis=1)).sum(axis=1)
    found = learn_theta([(Choices(known, features, chosen),)], wide=np.array(WIDE), rationality=0.3)
    assert (np.abs(found.theta - truth) < 4.0 * np.sqrt(np.diag(found.covariance))).all()
    assert (np.sqrt(np.diag(found.covariance)) < [0.05, 0.1, 5.0, 5.0]).all()


def test_a_robot_takes_people_for_what_was_learned(tmp_path, recorded, capfd) -> None:
    out = tmp_path / "hasty"
    command = ["irl", "people", "--dataset", str(recorded), "--type", "aggressive", "--holdout", "4"]
    assert main([*command, "--out", str(out), "--json"]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert printed["held_out"]["learned"] > printed["held_out"]["default"]
    reward = load_person_reward(out)
    options = DriverOptions(kind="passive", learned=theta_of([reward], 0.3))
    assert options.theta == {"passive": TYPES["passive"], "aggressive": reward.weights}
    actions = []
    for each in (options, DriverOptions(kind="passive")):
        robot, world = InteractiveDriver(MERGE, 5, each), DrivingWorld(MERGE, HastyDriver(MERGE, "random", 0.3), 5)
        seen = world.reset(np.random.default_rng(1000))
        robot.reset(np.random.default_rng(0))
        actions.append(robot.act(seen).action)
    assert np.abs(actions[0] - actions[1]).max() > 1e-6


@pytest.mark.slow
def test_interact_takes_a_learned_reward_and_says_where_it_is_from(tmp_path, people) -> None:
    found, out = learn_theta(people, wide=np.array(WIDE), rationality=0.3), tmp_path / "hasty"
    reward = reward_of(found)
    save_person_reward(reward, out, recipe={}, parents={}, overwrite=False)
    met = tmp_path / "met"
    command = ["interact", "merge", "--robot-kind", "known", "--episodes", "1", "--person-reward", str(out)]
    assert main([*command, "--out", str(met)]) == 0
    manifest = json.loads((met / "manifest.json").read_text())
    assert list(manifest["parents"]) == [str(out)]
    assert manifest["recipe"]["interact"]["robots"][0]["learned"] == [["aggressive", list(reward.weights)]]


def saved(folder, reward):
    save_person_reward(reward, folder / "saved", recipe={}, parents={}, overwrite=True)
    return folder / "saved"


def test_rewards_that_are_none_are_refused(tmp_path, recorded, lfd_fails) -> None:
    given = {"type": "passive", "features": FEATURES, "spread": (1.0,) * 4, "choices": 1, "log_likelihood": -1.0}
    reward = PersonReward(**given, weights=(0.1, 0.1, 1.0, 1.0), rationality=0.5)
    with pytest.raises(InputError, match="--rationality 0.3"):
        theta_of([reward], 0.3)
    with pytest.raises(InputError, match="give one for each type"):
        theta_of([reward, reward], 0.5)
    with pytest.raises(InputError, match="numbers from 0 on"):
        PersonReward(**given, weights=(-0.1, 0.1, 1.0, 1.0), rationality=0.3)
    save_person_reward(reward, tmp_path / "r", recipe={}, parents={}, overwrite=False)
    assert load_person_reward(tmp_path / "r") == reward
    (tmp_path / "r" / FILE).write_text("{}")
    with pytest.raises(InputError, match="is no reward of people"):
        load_person_reward(tmp_path / "r")
    with pytest.raises(InputError, match="holds no person.json; `lfd irl people"):
        load_person_reward(tmp_path)
    with pytest.raises(InputError, match="no episode to learn from"):
        learn_theta([], wide=np.array(WIDE), rationality=0.3)
    with pytest.raises(InputError, match="unknown type of person 'rude'"):
        DriverOptions(kind="known", learned=(("rude", (0.0,) * 4),)).check()
    out = tmp_path / "x"
    assert "give --type TYPE, one of passive" in lfd_fails("irl", "people", "--dataset", recorded, "--out", out)
    others = ["--type", "passive", "--features", "speed"]
    assert "leave them out" in lfd_fails("irl", "people", "--dataset", recorded, "--out", out, *others)
    command = ["irl", "people", "--dataset", recorded, "--out", out, "--type"]
    assert "unknown type of person 'rude'" in lfd_fails(*command, "rude")
    assert "leave none" in lfd_fails(*command, "passive", "--holdout", "14")
    given = ["--person-reward", tmp_path / "r", "--out", out]
    assert "--rationality 0.3" in lfd_fails("interact", "merge", *given[:1], saved(tmp_path, reward), *given[2:])
    given[1] = saved(tmp_path, replace(reward, rationality=0.3))
    assert "unknown type of person 'passive'" in lfd_fails("interact", "shared_table", *given)
    assert "where nobody is yields: give recordings of `lfd interact` in shared_table" in lfd_fails(*command, "yields")
    assert "above 0" in lfd_fails(*command, "passive", "--rationality", "0")
