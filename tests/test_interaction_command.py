import json

import numpy as np
import pytest

from lfd.cli import main
from lfd.core.errors import InputError
from lfd.interaction.driving_robots import DriverOptions
from lfd.loops.interacting import InteractRecipe, interval, run_trial, summary, told
from lfd.record.episode_file import read_episode
from lfd.replay.clip import clip_of


@pytest.mark.slow
def test_interact_records_beliefs_and_what_can_be_replayed(tmp_path, capfd) -> None:
    out = tmp_path / "merge"
    command = ["interact", "merge", "--robot-kind", "obstacle", "active", "--person", "passive", "--episodes", "2"]
    assert main([*command, "--out", str(out), "--json"]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert set(printed["robots"]) == {"obstacle", "active"}
    report = json.loads((out / "report.json").read_text())
    assert [trial["person"] for trial in report["trials"]["active"]] == ["passive", "passive"]
    assert (out / "entropy.png").stat().st_size > 10_000
    path = out / "active" / "episode_000001.mcap"
    episode = read_episode(path)
    assert episode.metadata.task == "merge"
    distances = [episode.observations[f"{car}_distance"].min() for car in ("person_car", "second_car")]
    assert min(distances) == pytest.approx(report["trials"]["active"][1]["least_distance"])
    clip = clip_of(out / "active", 1)
    assert clip.model is not None
    assert clip.qpos is not None
    np.testing.assert_allclose(clip.qpos[:, :2], episode.observations["robot_car_pos"][:, :2])
    saved = tmp_path / "merge.rrd"
    assert main(["replay", str(out / "active"), "--episode", "1", "--save", str(saved)]) == 0
    assert saved.stat().st_size > 10_000


def test_a_belief_is_on_a_topic_of_its_own(tmp_path) -> None:
    from lfd.record.episode_file import McapRecorder, Origin
    from lfd.record.mcap_file import read_mcap

    recipe = recipe_of(DriverOptions(kind="passive"))
    origin = Origin(stage="eval", policy="passive", seed=0, index=0, recipe={})
    trial = run_trial(recipe, recipe.robots[0], 0, [McapRecorder(tmp_path / "e.mcap", origin, keep_failures=True)])
    content = read_mcap(tmp_path / "e.mcap")
    assert len(content.messages["/belief"]) == len(content.messages["/belief/entropy"]) == len(trial.entropy)
    assert trial.entropy[0] == pytest.approx(np.log(2.0))


def recipe_of(*robots: DriverOptions, **keys) -> InteractRecipe:
    given = {"scene": "merge", "person": "random", "episodes": 1, "seed": 0, "max_seconds": 1.0, **keys}
    return InteractRecipe(robots=robots, **given)


def test_robots_of_a_recipe_meet_the_same_people() -> None:
    robots = DriverOptions(kind="obstacle"), DriverOptions(kind="passive")
    first, second = (run_trial(recipe_of(*robots), robot, 3) for robot in robots)
    assert first.offsets[0] == second.offsets[0]
    assert first.person == second.person
    assert first.certain_s is None
    assert second.certain_s is not None
    assert "of 1 there" in told(summary([second]))


def test_an_interval_is_students() -> None:
    mean, low, high = interval([1.0, 2.0, 3.0])
    assert (mean, high - mean) == (2.0, pytest.approx(4.302653 / np.sqrt(3.0)))
    assert mean - low == pytest.approx(high - mean)


def test_a_recipe_that_cannot_be_run_is_refused(lfd_fails, tmp_path) -> None:
    robot = DriverOptions(kind="known")
    for recipe, said in (
        (recipe_of(robot, robot), "each of them once"),
        (recipe_of(robot, episodes=0), "episodes = 0"),
        (recipe_of(robot, seed=-1), "seed = -1"),
        (recipe_of(robot, scene="roundabout"), "unknown scene 'roundabout'"),
    ):
        with pytest.raises(InputError, match=said):
            recipe.check()
    said = lfd_fails("interact", "merge", "--robot-kind", "known", "known", "--out", tmp_path / "x")
    assert "each of them once" in said
