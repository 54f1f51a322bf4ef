import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfd.cli import main
from lfd.core.errors import InputError
from lfd.loops.inverse_rl import joined
from lfd.reward_learning.weight_belief import belief_of, updated
from lfd.rewards.factors import ChoiceFactor, GaussianFactor, PushFactor
from lfd.rewards.reward_artifact import Change, LinearReward, load_reward, save_reward

SHOWN = GaussianFactor(np.array([-1.0, 0.5]), np.diag([4.0, 1.0]))
REWARD = LinearReward(
    features=("person_closeness", "cup_tilt"),
    weights=SHOWN.mean,
    ranges=np.array([2.0, 0.5]),
    robot="panda",
    waypoints=20,
    duration_s=60.0,
    smoothness=400.0,
    method="maxent",
    covariance=np.diag([0.25, 1.0]),
    history=(Change("5 demonstrations, maxent", (), (-1.0, 0.5), SHOWN),),
)
PUSH = PushFactor(np.array([-0.4, 1.0]))
ANSWER = ChoiceFactor(np.array([1.0, -2.0]), 0.3, "b", 2.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A reward of three pieces of evidence, with a report and a pool beside it."""
    reward = updated(updated(REWARD, PUSH, "a push"), ANSWER, "an answer")
    also = {"report.json": b"{}", "plan.rrd": b"", "comparing.json": b"{}", "notes.json": b"[1]"}
    parents = {"outputs/cup": "ab12"}
    save_reward(reward, tmp_path / "reward", recipe={"method": "maxent"}, parents=parents, seed=3, also=also)
    return tmp_path / "reward"


def printed(capfd: pytest.CaptureFixture[str], *arguments: object) -> dict:
    capfd.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capfd.readouterr().out)


def test_a_reward_is_shown_with_units_spread_and_what_it_comes_from(folder: Path, capfd) -> None:
    shown, reward = printed(capfd, "reward", "show", folder), load_reward(folder)
    assert reward.covariance is not None
    row = shown["weights"]["cup_tilt"]
    assert row["weight"] == reward.weights[1]
    assert row["spread"] == pytest.approx(reward.covariance[1, 1] ** 0.5)
    assert row["per_range_spread"] == pytest.approx(0.5 * row["spread"])
    assert row["unit"] == "1/(1 s)"
    assert shown["evidence"] == {"gaussian": 1, "push": 1, "choice": 1}
    assert shown["consistency"] == pytest.approx(belief_of(reward).consistency)
    assert shown["learned_from"] == ["outputs/cup"]
    assert main(["reward", "show", str(folder)]) == 0
    assert "mean chance of the answers" in " ".join(capfd.readouterr().out.split())


def test_the_history_tells_each_change(folder: Path, capfd) -> None:
    changes = printed(capfd, "reward", "history", folder)["changes"]
    assert [change["evidence"] for change in changes] == ["5 demonstrations, maxent", "a push", "an answer"]
    assert changes[1]["before"] == [-1.0, 0.5]
    np.testing.assert_allclose(changes[1]["after"], [-1.1, 1.5])
    assert main(["reward", "history", str(folder)]) == 0
    assert "1  a push\n     person_closeness         -1 -> -1.1 1/(1 s)" in capfd.readouterr().out


def test_undo_takes_changes_back_in_place_or_into_another_folder(
    folder: Path, tmp_path: Path, capfd, lfd_fails
) -> None:
    other = tmp_path / "other"
    assert printed(capfd, "reward", "undo", folder, "--out", other)["undone"] == "an answer"
    assert len(load_reward(folder).history) == 3
    found = load_reward(other)
    np.testing.assert_allclose(found.weights, [-1.1, 1.5])
    np.testing.assert_allclose(found.covariance, REWARD.covariance)  # type: ignore[arg-type]
    assert sorted(p.name for p in other.iterdir()) == ["manifest.json", "notes.json", "reward.json"]
    manifest = json.loads((other / "manifest.json").read_text())
    assert list(manifest["parents"]) == ["outputs/cup", str(folder)]
    assert manifest["recipe"] == {"method": "maxent", "undone": ["an answer"]}
    assert "exists already" in lfd_fails("reward", "undo", folder, "--out", other)
    for words in ("an answer", "a push"):
        assert printed(capfd, "reward", "undo", folder)["undone"] == words
    np.testing.assert_array_equal(load_reward(folder).weights, REWARD.weights)
    told = lfd_fails("reward", "undo", folder)
    assert "nothing to undo: the history has only what the reward began with (5 demonstrations, maxent)" in told
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["recipe"]["undone"] == ["an answer", "a push"]
    assert manifest["parents"] == {"outputs/cup": "ab12"}


def test_demonstrations_join_another_reward_in_any_order() -> None:
    other = GaussianFactor(np.array([0.0, 2.0]), np.array([[1.0, 0.2], [0.2, 3.0]]))
    learned = replace(REWARD, weights=other.mean, history=(Change("2 demonstrations, maxent", (), (0.0, 2.0), other),))
    first = updated(joined(updated(REWARD, PUSH, "a push"), learned), ANSWER, "an answer")
    second = joined(updated(updated(REWARD, ANSWER, "an answer"), PUSH, "a push"), learned)
    np.testing.assert_allclose(first.weights, second.weights, atol=1e-9)
    assert [c.evidence for c in second.history][-1] == "2 demonstrations, maxent"
    with pytest.raises(InputError, match="planned with duration_s = 30.0, the reward with 60.0; .* comparable only"):
        joined(REWARD, replace(learned, duration_s=30.0))
    turned = replace(learned, features=("cup_tilt", "person_closeness"))
    with pytest.raises(
        InputError, match="has the features cup_tilt, person_closeness, the reward has person_closeness"
    ):
        joined(REWARD, turned)
    vague = replace(learned, covariance=None, history=(Change("2 demonstrations, maxent", (), (0.0, 2.0), None),))
    with pytest.raises(InputError, match="2 demonstrations, maxent: these tell no spread of the weights"):
        joined(REWARD, vague)


def test_bad_input_is_a_sentence(lfd_fails, tmp_path: Path) -> None:
    irl = ("irl", "margin", "--dataset", tmp_path, "--reward", tmp_path, "--out", tmp_path / "out")
    assert "--reward joins evidence by its likelihood, which margin has not; use lfd irl maxent" in lfd_fails(*irl)
    assert "are for undo; `lfd reward history` writes nothing" in lfd_fails(
        "reward", "history", tmp_path, "--overwrite"
    )
    assert "holds no reward.json" in lfd_fails("reward", "show", tmp_path)
