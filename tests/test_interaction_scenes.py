import json

import numpy as np
import pytest

from lfd.cli import main
from lfd.core.errors import InputError
from lfd.interaction.interactive_robot import InteractiveRobot, RobotOptions
from lfd.interaction.scenes import SCENES, scene_of
from lfd.loops.interacting import InteractRecipe, run_trial
from lfd.record.episode_file import read_episode
from lfd.replay.clip import clip_of
from lfd.replay.verify import verify_replay
from lfd.worlds.shared_table_guard import LEAST_DISTANCE


@pytest.mark.slow
def test_a_table_is_shared_recorded_replayed_and_verified_bit_for_bit(tmp_path, capfd) -> None:
    out = tmp_path / "table"
    command = ["interact", "shared_table", "--robot-kind", "active", "--person", "insists", "--episodes", "1"]
    assert main([*command, "--seed", "3", "--out", str(out), "--json"]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert set(printed["robots"]) == {"active"}
    (trial,) = json.loads((out / "report.json").read_text())["trials"]["active"]
    assert trial["person"].endswith("-insists")
    assert (out / "entropy.png").stat().st_size > 10_000
    episode = read_episode(out / "active" / "episode_000000.mcap")
    assert episode.metadata.task == "shared_table"
    assert episode.observations["hand_distance"].min() == pytest.approx(trial["least_distance"])
    assert trial["least_distance"] >= LEAST_DISTANCE
    belief = episode.signals["belief"]
    assert belief.names == SCENES["shared_table"].types
    np.testing.assert_allclose(belief.values.sum(axis=1), 1.0)
    assert trial["entropy"][0] == pytest.approx(np.log(6.0))
    verified = verify_replay(out / "active", 0)  # in another world than that of the command: for any people
    assert (verified.deviation, verified.first_step, verified.steps) == (0.0, None, len(episode))
    clip = clip_of(out / "active", 0)
    assert clip.model is not None
    assert clip.qpos is not None
    hand = [clip.model.joint(f"person_hand_{axis}").qposadr[0] for axis in "xy"]
    np.testing.assert_allclose(clip.qpos[:, hand], episode.observations["hand_pos"][:, :2], atol=1e-12)
    saved = tmp_path / "table.rrd"
    assert main(["replay", str(out / "active"), "--episode", "0", "--save", str(saved)]) == 0
    assert saved.stat().st_size > 10_000


def test_robots_at_the_table_meet_the_same_people() -> None:
    robots = scene_of("shared_table").robots(("obstacle", "passive"))
    recipe = InteractRecipe(
        scene="shared_table", robots=robots, person="insists", episodes=1, seed=1003, max_seconds=0.4
    )
    first, second = (run_trial(recipe, robot, 2) for robot in robots)
    assert first.offsets[0] == second.offsets[0]
    assert first.person == second.person
    assert first.certain_s is None
    assert second.certain_s is not None


@pytest.mark.parametrize("name", sorted(SCENES))
def test_a_scene_has_robots_of_all_kinds_for_its_types(name) -> None:
    scene = scene_of(name)
    robots = scene.robots(("obstacle", "known", "passive", "active"))
    assert {robot.assumed for robot in robots} == {scene.assumed}
    assert scene.assumed in scene.types
    assert set(scene.types) < set(scene.people)
    for options in robots:
        options.check()
        assert isinstance(options, RobotOptions)
        assert isinstance(scene.robot(5, options), InteractiveRobot)


def test_what_a_scene_does_not_have_is_refused(lfd_fails, tmp_path) -> None:
    said = lfd_fails("interact", "shared_table", "--assumed", "aggressive", "--out", tmp_path / "x")
    assert "unknown type of person 'aggressive'" in said
    assert "middle-yields" in said
    said = lfd_fails("interact", "merge", "--person", "yields", "--out", tmp_path / "x")
    assert "unknown person 'yields'" in said
    assert "passive" in said
    with pytest.raises(InputError, match="shared_table"):
        scene_of("roundabout")
