import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfd.core.errors import InputError, OutputError, UnknownName
from lfd.rewards.factors import GaussianFactor, PushFactor
from lfd.rewards.reward_artifact import LinearReward, load_reward, save_reward

REWARD = LinearReward(
    features=("person_closeness", "cup_tilt"),
    weights=np.array([-1.0, -0.1]),
    ranges=np.array([0.3, 2.0]),
    robot="panda",
    waypoints=20,
    duration_s=40.0,
    smoothness=80.0,
    method="maxent",
    measures={"log_likelihood": -1.5},
    covariance=np.array([[0.1, 0.02], [0.02, 0.3]]),
)


def save(reward: LinearReward, out: Path) -> None:
    save_reward(reward, out, recipe={}, parents={"outputs/cup": "ab12"}, seed=3)


def test_a_reward_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    push = PushFactor(np.array([0.1, 1 / 3]))
    changed = REWARD.changed(np.array([-2.0, 1 / 3]), "a push", push, covariance=None)
    for reward in (REWARD, changed):
        out = tmp_path / str(len(reward.history))
        save(reward, out)
        found = load_reward(out)
        for name in ("features", "robot", "waypoints", "duration_s", "smoothness", "method", "measures"):
            assert getattr(found, name) == getattr(reward, name)
        for ours, theirs in zip(reward.history, found.history, strict=True):
            assert (theirs.evidence, theirs.before, theirs.after) == (ours.evidence, ours.before, ours.after)
            assert type(theirs.factor) is type(ours.factor)
            for name, value in vars(ours.factor).items():
                np.testing.assert_array_equal(getattr(theirs.factor, name), value)
        np.testing.assert_array_equal(found.weights, reward.weights)
        np.testing.assert_array_equal(found.ranges, reward.ranges)
        assert (found.covariance is None) == (reward.covariance is None)
        manifest = json.loads((out / "manifest.json").read_text())
        assert (manifest["kind"], manifest["method"]) == ("reward", "maxent")
        assert manifest["parents"] == {"outputs/cup": "ab12"}


def test_history_has_the_weights_before_and_after() -> None:
    once = REWARD.changed(np.array([-2.0, 0.0]), "one", None, covariance=None)
    twice = once.changed(np.array([-3.0, 1.0]), "two", None, covariance=np.eye(2))
    assert [(c.evidence, c.before, c.after) for c in twice.history] == [
        ("weights as they were (maxent)", (), (-1.0, -0.1)),
        ("one", (-1.0, -0.1), (-2.0, 0.0)),
        ("two", (-2.0, 0.0), (-3.0, 1.0)),
    ]
    assert REWARD.history == ()
    assert REWARD.covariance is not None
    begun = twice.history[0].factor
    assert isinstance(begun, GaussianFactor)
    np.testing.assert_allclose(begun.precision, np.linalg.inv(REWARD.covariance))
    assert twice.undone().history == once.history
    np.testing.assert_array_equal(twice.undone().weights, once.weights)
    with pytest.raises(InputError, match="nothing to undo: the history has only what the reward began with"):
        once.undone().undone()


def test_histories_of_before_are_refused_and_so_are_other_orders_of_features(tmp_path: Path) -> None:
    save(REWARD.changed(REWARD.weights, "a push", PushFactor(np.ones(2)), covariance=None), tmp_path / "reward")
    file = tmp_path / "reward" / "reward.json"
    good = json.loads(file.read_text())
    old = [{k: v for k, v in entry.items() if k != "factor"} for entry in good["history"]]
    file.write_text(json.dumps(good | {"history": old}))
    with pytest.raises(InputError, match="was written before histories kept the evidence itself.*learn it again"):
        load_reward(tmp_path / "reward")
    good["history"][1]["factor"]["features"].reverse()
    file.write_text(json.dumps(good))
    with pytest.raises(InputError, match="'a push' has the features cup_tilt, person_closeness, the reward has"):
        load_reward(tmp_path / "reward")


def test_units_are_those_of_counts() -> None:
    assert replace(REWARD, features=("table_distance", "joint_speed")).units == ("m s", "rad^2/s^2 s")


def test_what_is_no_reward_is_refused() -> None:
    with pytest.raises(UnknownName, match="unknown arm feature 'cup_tlt'; known: .* Did you mean 'cup_tilt'"):
        replace(REWARD, features=("person_closeness", "cup_tlt"))
    with pytest.raises(InputError, match=r"weights have shape \(3,\) .*2 features need \(2,\): person_closeness"):
        replace(REWARD, weights=np.zeros(3))
    with pytest.raises(InputError, match="weights have shape .* or are not finite"):
        replace(REWARD, weights=np.array([np.nan, 1.0]))
    with pytest.raises(InputError, match="each must be positive; leave out a feature that never varies"):
        replace(REWARD, ranges=np.array([1.0, 0.0]))


def test_folders_that_hold_no_reward_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no reward.json; `lfd irl METHOD --dataset RECORDINGS --out"):
        load_reward(tmp_path)
    out = tmp_path / "reward"
    save(REWARD, out)
    good = json.loads((out / "reward.json").read_text())
    for content, message in (
        ("{", "is no JSON"),
        ("[]", "is no reward: missing"),
        (json.dumps(good | {"colour": 1}), r"missing \[\], unknown \['colour'\]"),
        (json.dumps(good | {"weights": ["heavy", 1]}), "something else than numbers"),
        (json.dumps(good | {"weights": [1.0]}), r"weights have shape \(1,\)"),
        (json.dumps(good | {"features": ["person_closeness", "tilt"]}), "unknown arm feature 'tilt'"),
        (json.dumps(good | {"units": ["1 s", "deg s"]}), "in this lfd they are in 1 s, 1 s"),
    ):
        (out / "reward.json").write_text(content)
        with pytest.raises(InputError, match=message):
            load_reward(out)
    with pytest.raises(OutputError, match="exists already"):
        save(REWARD, out)
