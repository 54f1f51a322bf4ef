import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import check_grad

from lfd.cli import main
from lfd.core.errors import InputError
from lfd.core.recipe import build, load_toml
from lfd.loops.arm_evidence import Demonstration, Evidence, load_evidence, resampled
from lfd.loops.cup_scenes import Placement
from lfd.loops.inverse_rl import L2, Learned, Problem, _covariance, _of_weights, identifiable, learn, scene_softmax
from lfd.loops.plan_demonstrations import PlanRecipe, demonstrations_in, deviate, draw_scenes
from lfd.loops.reward_judging import costs, regret, split
from lfd.planning.arm_planner import MARGIN_M
from lfd.replay.verify import verify_replay
from lfd.rewards.reward_artifact import load_reward
from tests.conftest import ROOT, call_json

CUP = ROOT / "datasets" / "cup_panda.toml"


def recipe(scenes: int, **changes: object) -> PlanRecipe:
    return replace(build(PlanRecipe, load_toml(CUP, ("plan", "convert"))["plan"], "[plan]"), scenes=scenes, **changes)


@cache
def evidence(scenes: int, seed: int = 5) -> Evidence:
    """Plans as they are, without an arm that follows them."""
    about = recipe(scenes, seed=seed)
    found = Evidence(recipe=about, demonstrations=(), parents={})
    demonstrations = []
    for number, placement in enumerate(draw_scenes(about)):
        rng = np.random.default_rng(number)
        plan = about.planner(found.arm, placement).plan(np.array(about.weights), starts=about.starts, rng=rng)
        demonstrations.append(Demonstration(str(number), placement, plan.trajectory.copy()))
    return replace(found, demonstrations=tuple(demonstrations))


@pytest.fixture
def problem() -> Problem:
    return Problem(evidence(2), evidence(2).recipe.features, seed=0)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two demonstrations on the arm, by the command."""
    out = tmp_path_factory.mktemp("cup") / "recordings"
    assert main(["plan", str(CUP), "--demonstrations", "2", "--seed", "5", "--out", str(out)]) == 0
    return out


def test_scenes_differ_and_depend_on_seed_and_number_alone() -> None:
    three, two = draw_scenes(recipe(3)), draw_scenes(recipe(2))
    assert three[:2] == two
    assert len({placement.cup_start_m for placement in three}) == 3
    assert draw_scenes(recipe(1, seed=1))[0] != two[0]
    placement = two[0]
    assert Placement.of(json.loads(json.dumps(placement.table())), "a file") == placement
    planner = recipe(1).planner(evidence(2).arm, placement)
    for posture in (placement.start_rad, placement.goal_rad):
        assert planner.clearance(np.repeat(np.array(posture)[None, None], 2, axis=1))[0] >= MARGIN_M
    with pytest.raises(InputError, match="a file lacks goal_rad; record it again with `lfd plan`"):
        Placement.of({k: v for k, v in placement.table().items() if k != "goal_rad"}, "a file")


def test_deviations_have_the_size_that_was_asked_for_and_leave_the_ends(rng: np.random.Generator) -> None:
    shown = evidence(2)
    one = shown.demonstrations[0]
    planner = shown.planner(one.placement, shown.recipe.features)
    made = np.array([deviate(planner, one.trajectory, 0.02, rng) for _ in range(200)]) - one.trajectory
    np.testing.assert_array_equal(made[:, [0, -1]], 0.0)
    assert made[:, 10, :6].std() == pytest.approx(0.02, rel=0.1)
    assert deviate(planner, one.trajectory, 0.0, rng) is one.trajectory


@pytest.mark.slow
def test_a_demonstrator_who_is_rational_only_so_far_pays_more_than_the_plan_by_what_theory_says() -> None:
    best, soft = recipe(1, seed=5, per_scene=2), recipe(1, seed=5, per_scene=4, rationality=200.0)
    (placement,) = draw_scenes(best)
    plan, repeated = demonstrations_in(best, 0, placement)
    assert all(way is plan.trajectory for way in repeated)
    same, drawn = demonstrations_in(soft, 0, placement)
    np.testing.assert_array_equal(same.trajectory, plan.trajectory)
    planner = soft.planner(evidence(2).arm, placement)
    paid = costs(planner, soft.weights, soft.smoothness, np.array(drawn)) - plan.cost
    freedoms = 18 * 7  # of 20 waypoints without both ends; in a quadratic cost each of them costs 1 / (2 beta)
    assert paid.mean() == pytest.approx(freedoms / (2 * 200.0), rel=0.25)
    assert len({float(way[9, 0]) for way in drawn}) == 4
    np.testing.assert_array_equal(demonstrations_in(soft, 0, placement)[1], drawn)


def test_resampling_hits_what_was_seen() -> None:
    motion = np.array([[0.0, 1.0], [1.0, 0.0], [4.0, 1.0]])
    np.testing.assert_allclose(resampled(motion, 5), [[0, 1], [0.5, 0.5], [1, 0], [2.5, 0.5], [4, 1]])


def test_candidates_keep_the_ends_touch_nothing_and_are_counted_as_plans_are(problem: Problem) -> None:
    scene, shown = problem.scenes[0], evidence(2)
    placement = shown.demonstrations[0].placement
    planner = shown.planner(placement, shown.recipe.features)
    clear = planner.clearance(scene.trajectories)
    assert (clear[1:] >= min(clear[0], MARGIN_M)).all()
    np.testing.assert_allclose(scene.trajectories[:, 0], np.tile(placement.start_rad, (len(scene.counts), 1)))
    np.testing.assert_array_equal(scene.trajectories[0], shown.demonstrations[0].trajectory)
    np.testing.assert_allclose(scene.expert, scene.counts[0])
    weights = np.array(shown.recipe.weights)
    plan = planner.plan(weights, warm=scene.trajectories[0], starts=1)
    counted = scene.counted(plan.trajectory[None])[0]
    assert -counted @ np.append(weights, shown.recipe.smoothness) == pytest.approx(plan.cost)
    assert costs(planner, shown.recipe.weights, shown.recipe.smoothness, plan.trajectory[None])[0] == pytest.approx(
        plan.cost
    )
    assert scene.differences()[0] == 0
    assert (scene.differences()[1:] > 0).all()
    before, reward = len(scene.counts), np.append(weights, shown.recipe.smoothness)
    best = scene.plan(weights, shown.recipe.smoothness, starts=1, rng=None)
    assert len(scene.counts) == before + 1
    assert (scene.counts @ reward).argmax() == best
    gain = (scene.counts[best] - scene.counts[0]) @ reward
    assert 0 <= gain < 0.01 * plan.cost  # penalties for coming near to things are no part of a reward


def test_the_gradient_of_maximum_entropy_is_that_of_its_value(problem: Problem, rng: np.random.Generator) -> None:
    objective = scene_softmax(problem)
    v = rng.normal(0.0, 3.0, len(problem.ranges))
    assert check_grad(lambda v: objective(v)[0], lambda v: objective(v)[1], v) < 1e-4
    z = [scene.counts / problem.ranges for scene in problem.scenes]
    by_hand = sum(np.log(np.exp(t[0] @ v) / np.exp(t @ v).sum()) for t in z) - 0.5 * L2 * v @ v
    assert objective(v)[0] == pytest.approx(by_hand)


def test_the_covariance_is_the_inverse_curvature_and_is_carried_to_the_weights(problem: Problem) -> None:
    v = np.array([-1.0, -2.0, -3.0, -1.0, -2.0, 1.5])
    objective, step = scene_softmax(problem), 1e-5
    curvature = [
        (objective(v + step * unit)[1] - objective(v - step * unit)[1]) / (2 * step) for unit in np.eye(len(v))
    ]
    covariance = _covariance(problem, v)
    np.testing.assert_allclose(covariance, np.linalg.inv(-np.array(curvature)), rtol=1e-4, atol=1e-6)
    carried = _of_weights(problem, Learned(v, ("", np.zeros(1)), {}, covariance))
    assert carried is not None
    moved = [problem.weights(v + step * unit) - problem.weights(v - step * unit) for unit in np.eye(len(v))]
    slope = np.array(moved).T / (2 * step)
    np.testing.assert_allclose(carried, slope @ covariance @ slope.T, rtol=1e-5)


def test_weights_are_in_the_scale_that_the_prior_sets(problem: Problem) -> None:
    weights = np.array(evidence(2).recipe.weights)
    v = np.append(weights, problem.smoothness) * problem.ranges
    for scale in (0.1, 1.0, 30.0):
        np.testing.assert_allclose(problem.weights(scale * v), weights)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["apprenticeship", "margin", "maxent"])
def test_plans_with_what_was_learned_cost_at_most_5_percent_more_in_other_scenes(method: str) -> None:
    learned_from, held_out = split(evidence(14), 4)
    problem = Problem(learned_from, learned_from.recipe.features, seed=0)
    reward, found = learn(problem, method, learned_from)
    judged = regret(reward, held_out, seed=0)
    assert judged.scenes == 4
    assert judged.mean <= 0.05
    assert reward.history[0].after == tuple(reward.weights)
    assert all(identifiable(problem))
    assert found.curve[1][-1] < 0.2 * found.curve[1].max()


def test_a_feature_that_is_another_in_disguise_is_not_identifiable(problem: Problem) -> None:
    assert identifiable(problem) == [True] * 5
    for scene in problem.scenes:
        scene.counts[:, 1] = 2.0 * scene.counts[:, 0] + 3.0
    assert identifiable(problem) == [False, False, True, True, True]


def test_scenes_that_are_held_out_are_the_last(problem: Problem) -> None:
    first, last = split(evidence(2), 1)
    assert ([d.source for d in first.demonstrations], [d.source for d in last.demonstrations]) == (["0"], ["1"])
    with pytest.raises(InputError, match="there are 2 scenes: 2 cannot be held out; --holdout takes fewer"):
        split(evidence(2), 2)


@pytest.mark.slow
def test_from_demonstrations_on_the_arm_to_plans_beside_them(recordings: Path, tmp_path: Path, capfd) -> None:
    dataset, reward, plans, picture = (tmp_path / n for n in ("dataset", "reward", "plans", "plan.rrd"))
    assert verify_replay(recordings, 0).deviation == 0.0  # with the controller that it was recorded with
    from_recordings, planned = load_evidence(recordings), evidence(2)
    for seen, meant in zip(from_recordings.demonstrations, planned.demonstrations, strict=True):
        assert seen.placement == meant.placement
    assert main(["convert", str(recordings), "--out", str(dataset)]) == 0
    from_dataset = load_evidence(dataset)
    for one, other in zip(from_recordings.demonstrations, from_dataset.demonstrations, strict=True):
        np.testing.assert_allclose(one.trajectory, other.trajectory, atol=1e-2)  # a dataset lacks the last observation
    counted = call_json(["features", str(recordings)])
    assert counted["demonstrations"] == 2
    mean = from_recordings.counts(["cup_tilt"]).mean()
    assert counted["features"]["cup_tilt"]["mean"] == pytest.approx(mean)
    printed = call_json(["irl", "maxent", "--dataset", str(dataset), "--holdout", "1", "--out", str(reward)])
    assert set(printed["weights"]) == set(load_reward(reward).features)
    assert printed["regret"]["scenes"] == 1
    assert (reward / "convergence.png").read_bytes().startswith(b"\x89PNG")
    assert main(["trace", str(reward)]) == 0
    assert "episode_000001.mcap: intact" in capfd.readouterr().out
    done = call_json(["plan", str(reward), "--demonstrations", "1", "--out", str(plans), "--save", str(picture)])
    assert (done["episodes"], done["failures"]) == (1, 0)
    assert done["tracking_rad"] < 0.02
    assert "planned" in done["person_closeness"]
    paths = entities(picture)
    assert {"/world/scene/box_1", "/world/scene/capsule_2", "/world/paths/ee", "/world/paths/demonstration_0"} <= paths
    (recordings / "episode_000001.mcap").rename(tmp_path / "elsewhere.mcap")
    with pytest.raises(InputError, match="the scenes of .* are in the recording .*1.mcap, which is gone"):
        load_evidence(dataset)
    (tmp_path / "elsewhere.mcap").rename(recordings / "episode_000001.mcap")


def entities(path: Path) -> set[str]:
    from rerun.experimental import RrdReader

    return {str(chunk.entity_path) for chunk in RrdReader(path).stream()}


def test_bad_input_is_a_sentence(lfd_fails, thread, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def irl(*more: str | Path) -> str:
        return lfd_fails("irl", "maxent", "--out", out, *more)

    neither, make = (
        "is neither recordings of plans nor a dataset of them: ",
        "`lfd plan datasets/cup_panda.toml --out DIR`",
    )
    for source in (thread.recordings, thread.dataset):
        said = lfd_fails("features", source)
        assert f"{source} {neither}" in said
        assert f"keeps no scene to plan in; {make}" in said
    (one, *_) = sorted(thread.recordings.glob("*.mcap"))
    assert f"{one} keeps no scene to plan in; {make}" in irl("--dataset", one)
    said = lfd_fails("features", thread.policy)
    assert f"{thread.policy} {neither}it holds no .mcap file and no meta/info.json; {make}" in said
    (foreign := tmp_path / "foreign").mkdir()
    (foreign / "garbage.mcap").write_bytes(b"no recording of anything")
    assert f"{foreign} is not all recordings of plans: {foreign / 'garbage.mcap'}" in lfd_fails("features", foreign)
    assert "no recording" in irl("--dataset", tmp_path / "none")
    assert "holds no reward.json" in lfd_fails("plan", thread.recordings, "--out", out)
    assert "no recipe" in lfd_fails("plan", tmp_path / "none.toml", "--out", out)
    plan = ("plan", CUP, "--out", out)
    assert "has 1 weights for 5 features: one for each" in lfd_fails(*plan, "--set", "plan.weights=[1.0]")
    both = lfd_fails(*plan, "--set", "plan.rationality=100.0", "--noise", "0.1")
    assert "two ways to deviate from the optimum; set one of them to 0" in both
    assert "rationality = -1.0: must not be negative, and finite" in lfd_fails(*plan, "--set", "plan.rationality=-1.0")
    assert "unknown robot" in lfd_fails(*plan, "--robot", "pnda")
    assert "let it take" in lfd_fails(*plan, "--set", "plan.duration_s=5")
    assert "there will be plans 0 to 9" in lfd_fails(*plan, "--episode", "10", "--save", tmp_path / "x.rrd")
