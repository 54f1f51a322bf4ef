import numpy as np
import pytest

from lfd import make_world
from lfd.core.errors import InputError, UnknownName
from lfd.worlds.rollout import episode_rng


def test_the_observation_has_the_labels_of_the_spec(lift_world) -> None:
    seen = lift_world.reset(np.random.default_rng(0))
    sizes = {name: len(names) for name, names in lift_world.spec.labels.items() if name != "action"}
    assert {name: len(values) for name, values in seen.items()} == sizes
    assert len(lift_world.spec.labels["action"]) == len(lift_world.spec.action_low) == 7


def robosuites_names(world, name: str) -> list[str]:
    """What robosuite's own observables call a channel of ours, arm by arm for those of joints."""
    if name in ("handle_point", "Door_qpos") and world.spec.task == "Door":
        return ["handle_pos"] if name == "handle_point" else ["hinge_qpos", "handle_qpos"]
    name = {"Door_pos": "door_pos"}.get(name, name)
    if name.endswith("_point"):
        return [name.replace("_point", "_xpos")]
    if not name.startswith(("joint_", "gripper_")) and "ee_" not in name:
        return [name]
    prefixes = {"": ["robot0"], "robot0_": ["robot0", "robot1"], "right_": ["robot0_right", "robot0_left"]}
    owners = prefixes[world._sight.prefixes[0]]
    if "ee_" in name:
        owner = name[: name.index("ee_")].removesuffix("_") or "robot0"
        owner = f"robot0_{owner}" if owner in ("right", "left") else owner
        return [f"{owner}_eef_pos" if name.endswith("pos") else f"{owner}_eef_quat_site"]
    if name.startswith("joint_"):
        return [f"{robot}_{name}" for robot in dict.fromkeys(o[:6] for o in owners)]
    return [f"{owner}_{name.replace('_', '_q')}" for owner in owners]


@pytest.mark.parametrize(
    ("task", "robot"),
    [("Lift", "panda"), ("Stack", "ur5e"), ("Door", "panda"), ("NutAssembly", "panda"), ("PickPlace", "sawyer"),
     ("TwoArmLift", "panda"), ("TwoArmLift", "baxter"), ("TwoArmPegInHole", "panda"), ("TwoArmHandover", "panda")],
)  # fmt: skip
def test_observations_equal_robosuites_own_computed_afresh(task, robot, rng) -> None:
    world = make_world(task, robot, 20)
    world.reset(rng)
    seen = world.step(rng.uniform(-1, 1, len(world.spec.action_low))).observation
    for observable in world._env._observables.values():
        observable.set_enabled(True)
    theirs = world._env._get_observations(force_update=True)
    compared = 0
    for name, ours in seen.items():
        if name.endswith("_effort") or name == "Door_quat" or name in ("peg_pos", "TwoArm"):
            continue  # robosuite has none
        own = np.concatenate([np.atleast_1d(theirs[their]) for their in robosuites_names(world, name)])
        if name.endswith("_quat"):  # xyzw, either sign, and rounded to single precision for the gripper
            own = np.roll(own, 1) * np.sign(np.dot(np.roll(own, 1), ours))
        np.testing.assert_allclose(ours, own, atol=1e-6 if name.endswith("ee_quat") else 1e-12, err_msg=name)
        compared += 1
    assert compared >= 7


def test_the_same_seed_gives_the_same_start_bit_for_bit(lift_world) -> None:
    starts = []
    for _ in range(2):
        np.random.seed(np.random.randint(1000))  # whatever ran before
        lift_world.reset(np.random.default_rng(5))
        starts.append(lift_world.get_state())
    assert starts[0].model_xml == starts[1].model_xml
    np.testing.assert_array_equal(starts[0].sim, starts[1].sim)
    lift_world.reset(np.random.default_rng(6))
    assert (lift_world.sim_state() != starts[0].sim).any()


@pytest.mark.parametrize(
    "task", ["Lift", "TwoArmLift", "Door", "PickPlaceSingle", "TwoArmPegInHole", "TwoArmHandover", "TwoArmTransport"]
)
def test_a_reset_without_rebuilding_gives_robosuites_own_start(task) -> None:
    """Same draws: model, state and controllers equal those of robosuite's hard reset, bit for bit."""
    world = make_world(task, "panda", 20)
    for seed in range(3):
        world.reset(np.random.default_rng(seed))
        ours, fields = world.get_state(), model_fields(world)
        world._is_guest = True  # robosuite rebuilds the model
        world.reset(np.random.default_rng(seed))
        theirs = world.get_state()
        np.testing.assert_array_equal(ours.sim, theirs.sim)
        for key in ours.memory.keys() & theirs.memory.keys():
            np.testing.assert_array_equal(ours.memory[key], theirs.memory[key], err_msg=key)
        for name, values in model_fields(world).items():
            np.testing.assert_array_equal(fields[name], values, err_msg=name)
        assert sizes(ours.model_xml) == sizes(theirs.model_xml)


@pytest.mark.parametrize(("task", "what"), [("Stack", "cubeA_pos"), ("Wipe", "joint_pos")])
def test_where_loading_draws_what_it_does_not_use_the_distribution_is_robosuites(task, what) -> None:
    """Stack draws sizes of a single value while loading, Wipe dirt that it moves at once."""
    from scipy.stats import kstest

    world, starts = make_world(task, "panda", 20), {}
    for rebuilds in (False, True):
        drawn = []
        for seed in range(25):
            world._is_guest = rebuilds
            drawn.append(world.reset(np.random.default_rng(100 * rebuilds + seed))[what][:2])
        starts[rebuilds] = np.array(drawn)
    for axis in (0, 1):
        assert kstest(starts[False][:, axis], starts[True][:, axis])[1] > 0.01


def model_fields(world) -> dict[str, np.ndarray]:
    """Every number of the compiled model."""
    named = {name: getattr(world._model, name) for name in dir(world._model) if not name.startswith("_")}
    return {name: value.copy() for name, value in named.items() if isinstance(value, np.ndarray)}


def sizes(xml: str) -> list[str]:
    import xml.etree.ElementTree as ET

    return [geom.get("size", "") for geom in ET.fromstring(xml).iter("geom")]


def test_cube_sizes_are_drawn_from_robosuites_range(lift_world) -> None:
    drawn = []
    for seed in range(60):
        lift_world.reset(np.random.default_rng(seed))
        drawn.append(lift_world._model.geom("cube_g0").size.copy())
    assert np.min(drawn) >= 0.020
    assert np.max(drawn) <= 0.022
    assert np.std(drawn) == pytest.approx(0.002 / np.sqrt(12), rel=0.2)


def test_a_reset_leaves_the_global_random_state_alone(lift_world) -> None:
    np.random.seed(11)
    expected = np.random.random()
    np.random.seed(11)
    lift_world.reset(np.random.default_rng(0))
    assert np.random.random() == expected


def test_a_restored_state_has_the_same_future_bit_for_bit(lift_world, rng) -> None:
    actions = rng.uniform(-1, 1, (30, 7))
    lift_world.reset(rng)
    kept, states = {}, []
    for t, action in enumerate(actions):
        if t in (0, 12):
            kept[t] = lift_world.get_state()
        lift_world.step(action)
        states.append(lift_world.sim_state())
    fresh = make_world("Lift", "panda", 20)
    for world in (lift_world, fresh):
        for t, state in kept.items():
            world.reset(np.random.default_rng(99))  # another cube, another controller memory
            world.set_state(state)
            for action, expected in zip(actions[t:], states[t:], strict=True):
                world.step(action)
                np.testing.assert_array_equal(world.sim_state(), expected)


@pytest.mark.parametrize("task", ["Door", "Wipe", "PickPlaceCan", "TwoArmTransport"])
def test_a_state_can_go_to_another_world_with_all_that_a_reset_placed(task, rng) -> None:
    from lfd.worlds.cameras import load_model

    world, other = make_world(task, "panda", 20), make_world(task, "panda", 20)
    actions = rng.uniform(-1, 1, (12, len(world.spec.action_low)))
    for seed in (1, 2):
        world.reset(np.random.default_rng(seed))
        for action in actions[:4]:
            world.step(action)
        state = world.get_state()
        np.testing.assert_allclose(load_model(state.model_xml).body_pos, world._model.body_pos, atol=0)
        expected = [world.step(action).observation for action in actions[4:]]
        seen = other.set_state(state)
        for action, wanted in zip(actions[4:], expected, strict=True):
            seen = other.step(action).observation
            for name, values in wanted.items():
                np.testing.assert_array_equal(seen[name], values, err_msg=name)


def test_stages_start_from_different_states_for_the_same_seed(lift_world) -> None:
    lift_world.reset(episode_rng("record", 0, 0))
    demonstrated = lift_world.sim_state()
    lift_world.reset(episode_rng("eval", 0, 0))
    assert (lift_world.sim_state() != demonstrated).any()


@pytest.mark.parametrize(
    ("action", "message"),
    [(np.zeros(6), r"shape \(6,\), panda takes \(7,\)"), (np.full(7, np.nan), "not finite")],
)
def test_an_action_that_does_not_fit_never_reaches_physics(lift_world, action, message) -> None:
    lift_world.reset(np.random.default_rng(0))
    before = lift_world.sim_state()
    with pytest.raises(InputError, match=message):
        lift_world.step(action)
    np.testing.assert_array_equal(lift_world.sim_state(), before)


def test_actions_beyond_the_limits_are_clipped_counted_and_said_once(caplog) -> None:
    world = make_world("Lift", "panda", 20)
    results = []
    for action in (np.full(7, 1.0), np.full(7, 1.5)):
        world.reset(np.random.default_rng(0))
        results.append((world.step(action).clipped, world.step(np.zeros(7)).clipped, world.sim_state()))
    assert results[0][:2] == (False, False)
    assert results[1][:2] == (True, False)
    np.testing.assert_array_equal(results[0][2], results[1][2])
    world.step(np.full(7, 2.0))
    assert caplog.text.count("are clipped") == 1


@pytest.mark.parametrize("stepper", ["compiled", "robosuite"])
def test_unstable_physics_ends_the_episode_with_the_reason(stepper, tmp_path, monkeypatch) -> None:
    """A real instability: the cube thrown faster than MuJoCo's limit, in mid-episode."""
    from lfd import rollout
    from lfd.core.protocols import Decision
    from lfd.record.episode_file import McapRecorder, Origin, read_episode
    from lfd.record.mcap_file import read_mcap

    world = make_world("Lift", "panda", 20, stepper)
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into MUJOCO_LOG.TXT of the current folder

    class Thrower:
        name, steps = "thrower", 0

        def reset(self, rng):
            pass

        def act(self, observation):
            self.steps += 1
            if self.steps == 4:
                world._data.qvel[-6] = 1e11
            return Decision(np.zeros(7))

    path = tmp_path / "broken.mcap"
    recorder = McapRecorder(path, Origin(stage="eval", policy="p", seed=0, index=0, recipe={}), keep_failures=True)
    outcome = rollout(world, Thrower(), [recorder], np.random.default_rng(0), horizon=50, hold_steps=1)
    assert not outcome.success
    assert outcome.steps == 4
    assert "mjWARN_BADQ" in outcome.failure
    episode = read_episode(path)
    assert all(np.isfinite(values).all() for values in episode.observations.values())
    assert episode.sim_states is not None
    assert np.isfinite(episode.sim_states).all()
    assert "mjWARN_BADQ" in read_mcap(path).metadata["lfd.episode_end"]["failure"]
    assert world.reset(np.random.default_rng(1))["cube_pos"][2] == pytest.approx(0.83, abs=0.02)
    assert not world.step(np.zeros(7)).failure


def test_unknown_names_list_the_known() -> None:
    with pytest.raises(UnknownName, match="unknown task 'Lif'; known: Door, Lift, .*Did you mean 'Lift'"):
        make_world("Lif", "panda", 20)
    with pytest.raises(
        UnknownName, match="unknown robot 'pandas'; known: baxter, iiwa, jaco, kinova3, panda, sawyer, ur5e."
    ):
        make_world("Lift", "pandas", 20)


def test_a_world_asks_for_little_memory_and_the_heaviest_task_needs_less(rng) -> None:
    world = make_world("ToolHang", "panda", 20)
    data = world._env.sim.data._data
    world.reset(rng)
    for _ in range(20):
        world.step(rng.uniform(-1, 1, len(world.spec.action_low)))
    assert data.maxuse_arena < world._model.narena / 20
    assert world._model.narena <= 64 * 2**20


def test_a_push_acts_until_told_otherwise_and_is_part_of_the_state(lift_world) -> None:
    """A cube on the table, held up by its weight and half as much again: it rises at half of g."""
    lift_world.reset(np.random.default_rng(3))
    model = lift_world._model
    weight = 9.81 * model.body("cube_main").mass[0]
    lift_world.push("cube_main", np.array([0.0, 0.0, 1.5 * weight, 0.0, 0.0, 0.0]))
    action = np.zeros_like(lift_world.spec.action_low)
    start = lift_world.get_state()
    heights = [lift_world.step(action).observation["cube_pos"][2] for _ in range(5)]
    rise = np.diff(heights, n=2) * lift_world.spec.control_hz**2
    np.testing.assert_allclose(rise, 0.5 * 9.81, rtol=0.05)
    lift_world.set_state(start)
    assert [lift_world.step(action).observation["cube_pos"][2] for _ in range(5)] == heights
    with pytest.raises(InputError, match="no body 'cup' to push in Lift with panda"):
        lift_world.push("cup", np.zeros(6))
    lift_world.push("cube_main", np.zeros(6))
