import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.experts.lift import LiftExpert
from tests.conftest import ROOT

CALM = {"HF_HUB_OFFLINE": "1", "WANDB_MODE": "disabled", "OMP_NUM_THREADS": "1"}


def lerobot(home: Path, *arguments: str) -> str:
    """Run one of LeRobot's commands as a person would, with an empty cache; what it printed."""
    command = [str(Path(sys.executable).with_name(arguments[0])), *arguments[1:]]
    around = {**os.environ, **CALM, "HF_HOME": str(home)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=around)
    assert done.returncode == 0, done.stderr[-3000:]
    assert not (home / "hub").exists()  # nothing was downloaded
    return done.stdout + done.stderr


def config(dataset: Path, **given: Any):
    from lfd.run.lerobot_env import LfdEnvConfig

    return LfdEnvConfig(**{"dataset": str(dataset), "view": "none", "max_seconds": 3.0, "hold_seconds": 0.2, **given})


def envs_of(made: Any, n: int):
    return made.create_envs(n, use_async_envs=True)["lfd"][0]


@pytest.fixture(scope="module")
def three(thread):
    """Three worlds of the thread's dataset."""
    envs = envs_of(config(thread.dataset), 3)
    yield envs
    envs.close()


def test_the_features_are_those_of_the_dataset(thread) -> None:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.envs.utils import env_to_policy_features
    from lerobot.utils.feature_utils import dataset_to_policy_features

    made = config(thread.dataset)
    features = LeRobotDatasetMetadata("local/lift", root=thread.dataset).features
    assert env_to_policy_features(made) == dataset_to_policy_features(features)
    assert (made.task, made.robot, made.controller, made.fps) == ("Lift", "panda", "OSC_POSE", 20)


def test_the_folder_of_a_policy_says_the_same_as_its_dataset(thread) -> None:
    assert config(thread.policy).features == config(thread.dataset).features


def test_observations_are_the_rows_that_the_dataset_has(thread, three) -> None:
    """The start of a demonstration, seen by the environment and stored in the dataset."""
    from lerobot.envs.utils import preprocess_observation

    from lfd.convert.dataset.dataset_files import DatasetFiles
    from lfd.record.episode_file import read_episode, recordings_in

    episode = read_episode(recordings_in([thread.recordings])[0])
    assert episode.sim_states is not None
    env, row = three.envs[0], DatasetFiles(thread.dataset).read(0).columns
    world = env._arm.world
    world.set_state(replace(world.get_state(), model_xml=episode.model_xml, sim=episode.sim_states[0]))
    seen = preprocess_observation(env._observe(world.observe()))
    assert set(seen) == {"observation.state", "observation.environment_state"}
    for feature, values in seen.items():
        np.testing.assert_array_equal(values[0].numpy(), row[feature][0])


def test_a_policy_decides_in_lerobots_loop_as_in_ours(thread, three, lift_world) -> None:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.utils import preprocess_observation
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    from lfd.policies.acting import LearnedPolicy

    settings = PreTrainedConfig.from_pretrained(thread.policy)
    policy = get_policy_class(settings.type).from_pretrained(thread.policy)
    before, after = make_pre_post_processors(settings, pretrained_path=str(thread.policy))
    seen, _ = three.reset(seed=[4, 5, 6])
    actions = after(policy.select_action(before(preprocess_observation(seen)))).numpy()
    own = LearnedPolicy(thread.policy, lift_world.spec)
    for env, action in zip(three.envs, actions, strict=True):
        world = env._arm.world
        own.reset(np.random.default_rng(0))
        named = {name: world.observe()[place] for name, place in world.layout.items()}
        np.testing.assert_allclose(own.act(named).action, action, atol=1e-6)


def test_an_episode_that_is_over_stands_still_and_keeps_its_result(three) -> None:
    """Two worlds are solved by the expert, one by nobody; the first to end waits for the others."""
    three.reset(seed=[1, 2, 3])
    experts = []
    for env in three.envs[:2]:
        experts.append(LiftExpert(env._arm.world.spec))
        experts[-1].reset(np.random.default_rng(0))
    ends: list[int | None] = [None, None, None]
    kept: list[Any] = [None, None, None]
    total = np.zeros(3)
    for step in range(three.call("_max_episode_steps")[0]):
        actions = np.zeros((3, 7), dtype=np.float32)
        for place, expert in enumerate(experts):
            world = three.envs[place]._arm.world
            named = {name: world.observe()[at] for name, at in world.layout.items()}
            actions[place] = expert.act(named).action
        seen, rewards, terminated, truncated, info = three.step(actions)
        for place in range(3):
            if ends[place] is None and (terminated | truncated)[place]:
                ends[place], kept[place] = step, {key: rows[place].copy() for key, rows in seen.items()}
                assert info["is_success"][place] == (place < 2)
                total[place] += rewards[place]
            elif ends[place] is None:
                assert not info["is_success"][place]
                total[place] += rewards[place]
            else:
                assert rewards[place] == 0
                assert info["is_success"][place] == (place < 2)
                assert (terminated | truncated)[place]
                for key, rows in seen.items():
                    np.testing.assert_array_equal(rows[place], kept[place][key])
    assert ends[2] == 59
    assert ends[0] is not None
    assert ends[1] is not None
    assert max(ends[0], ends[1]) < 59
    assert total[2] == 0
    assert total[0] == total[1] == 4  # the reward of each of the 0.2 s in which the cube is held up
    three.reset(seed=[1, 2, 3])
    assert not three.step(np.zeros((3, 7), dtype=np.float32))[4]["is_success"].any()


def test_lerobots_count_of_successes_is_ours(three) -> None:
    """Its evaluation of a policy that does nothing, in a batch whose last episode is thrown away."""
    import torch
    from lerobot.policies.pretrained import PreTrainedPolicy
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.scripts.lerobot_eval import eval_policy

    from lfd.policies.configuration_bc_mlp import BcMlpConfig

    class Idle(PreTrainedPolicy):
        config_class = BcMlpConfig  # type: ignore[assignment]
        name = "idle"  # type: ignore[assignment]

        def reset(self) -> None: ...
        def forward(self, batch: Any) -> Any: ...
        def get_optim_params(self) -> Any: ...
        def predict_action_chunk(self, batch: Any, **kwargs: Any) -> Any: ...
        def select_action(self, batch: Any, **kwargs: Any) -> torch.Tensor:
            return torch.zeros(3, 7)

    same = PolicyProcessorPipeline(steps=[])
    action = PolicyProcessorPipeline(steps=[], to_transition=lambda x: x, to_output=lambda x: x)
    told = eval_policy(three, Idle(BcMlpConfig(device="cpu")), same, action, same, action, n_episodes=5, start_seed=9)
    assert [row["success"] for row in told["per_episode"]] == [False] * 5
    assert [row["seed"] for row in told["per_episode"]] == [9, 10, 11, 12, 13]


def test_worlds_are_the_same_whatever_their_number(thread, three) -> None:
    one = envs_of(config(thread.dataset), 1)
    alone, together = one.reset(seed=[5])[0], three.reset(seed=[4, 5, 6])[0]
    action = np.full((3, 7), 0.3, dtype=np.float32)
    for _ in range(5):
        for key, rows in alone.items():
            np.testing.assert_array_equal(rows[0], together[key][1])
        alone, together = one.step(action[:1])[0], three.step(action)[0]
    one.close()


def test_another_robot_controller_or_rate_needs_force(thread) -> None:
    for key, value in (("robot", "ur5e"), ("controller", "JOINT_POSITION"), ("fps", 10)):
        with pytest.raises(InputError, match=rf"--env.{key}={value}, but .*leave --env.{key} out, or add --env.force"):
            config(thread.dataset, **{key: value})
    envs = envs_of(config(thread.dataset, fps=10, force=True), 1)
    assert envs.metadata["render_fps"] == 10
    assert envs.call("_max_episode_steps") == (30,)
    envs.close()
    with pytest.raises(InputError, match=r"'joint_pos.robot0_joint1', which Lift with ur5e does not observe"):
        envs_of(config(thread.dataset, robot="ur5e", force=True), 1)
    with pytest.raises(InputError, match="actions have 7 numbers, panda with JOINT_POSITION takes 8"):
        envs_of(config(thread.dataset, controller="JOINT_POSITION", force=True), 1)


def test_another_task_is_a_question_and_one_without_the_objects_an_error(thread) -> None:
    with pytest.raises(InputError, match=r"the dataset has 'cube_pos.x', which Door with panda does not observe"):
        envs_of(config(thread.dataset, task="Door"), 1)


def test_folders_and_times_that_cannot_be(thread, tmp_path: Path) -> None:
    from lfd.run.lerobot_env import LfdEnvConfig

    with pytest.raises(InputError, match=r"needs --env.dataset=FOLDER"):
        LfdEnvConfig()
    with pytest.raises(InputError, match=r"is no dataset \(it has no meta/info.json\) and no policy"):
        config(tmp_path)
    with pytest.raises(InputError, match=r"max_seconds=0.0 .* must be greater than 0"):
        config(thread.dataset, max_seconds=0.0)


def test_the_pictures_of_a_dataset_are_seen_in_its_size(thread, tmp_path: Path) -> None:
    from lerobot.envs.utils import env_to_policy_features, preprocess_observation

    dataset = shutil.copytree(thread.dataset, tmp_path / "dataset")
    info = json.loads((dataset / "meta" / "info.json").read_text())
    info["features"]["observation.images.frontview"] = {
        "dtype": "video",
        "shape": [48, 64, 3],
        "names": ["height", "width", "channels"],
    }
    (dataset / "meta" / "info.json").write_text(json.dumps(info))
    made = config(dataset)
    assert env_to_policy_features(made)["observation.images.frontview"].shape == (3, 48, 64)
    envs = envs_of(made, 1)
    seen, _ = envs.reset(seed=[0])
    batch = preprocess_observation(seen)
    assert batch["observation.images.frontview"].shape == (1, 3, 48, 64)
    np.testing.assert_array_equal(envs.render()[0], seen["pixels"]["frontview"][0])
    assert seen["pixels"]["frontview"].std() > 10
    envs.close()
    assert "observation.images.frontview" not in config(dataset, pictures=False).features


def test_videos_show_the_view_or_are_black(thread, three) -> None:
    three.reset(seed=[1, 2, 3])
    assert not three.envs[0].render().any()
    envs = envs_of(config(thread.dataset, view="frontview"), 1)
    envs.reset(seed=[1])
    (picture,) = envs.render()
    assert picture.shape == (256, 256, 3)
    assert picture.std() > 10
    envs.close()


@pytest.mark.slow
def test_lerobot_eval_runs_our_policy_in_our_world(thread, tmp_path: Path) -> None:
    out = tmp_path / "eval"
    printed = lerobot(
        tmp_path / "home",
        "lerobot-eval",
        *(f"--policy.path={thread.policy}", "--policy.device=cpu"),
        *("--env.discover_packages_path=lfd.run.lerobot_env", "--env.type=lfd", f"--env.dataset={thread.dataset}"),
        *("--env.max_seconds=1", "--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={out}"),
    )
    assert "End of eval" in printed
    told = json.loads((out / "eval_info.json").read_text())
    assert told["overall"]["n_episodes"] == 2
    assert told["overall"]["pc_success"] == 0
    assert len(list(out.rglob("*.mp4"))) == 2
