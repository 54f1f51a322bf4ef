"""Corrections in the simulator: an arm carries a cup, a person pushes it, and it learns what they care for.

Each run is one way from start to goal, recorded as MCAP with the push, its estimate, plans and weights on topics of
their own. Weights stay from run to run; the reward at the end has every push in its history.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError, RecipeError, UnknownName
from lfd.core.protocols import Observer, Progress, Transition, World, silent
from lfd.core.recipe import as_table
from lfd.experts.impedance import CONTROLLER
from lfd.experts.pushing import LEVER_M, Person, PushedArm, ScriptedPerson
from lfd.loops.correction_tasks import FEATURES, RANGE_1, load_correction_task
from lfd.loops.cup_scenes import Placement
from lfd.loops.plan_demonstrations import TASK, stand
from lfd.planning.arm_model import load_arm
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.external_torque import ArmDynamics
from lfd.record.demonstrations import begin_recordings, make_recorder
from lfd.reward_learning.learning_from_pushes import RULES, PushLearner
from lfd.reward_learning.weight_belief import belief_of, updated
from lfd.rewards.factors import GaussianFactor, PushFactor
from lfd.rewards.reward_artifact import Change, LinearReward
from lfd.run.correctable_arm import RESPONSES, CorrectableArm, Update
from lfd.worlds.cameras import load_model
from lfd.worlds.robosuite_world import RobosuiteWorld, make_world
from lfd.worlds.robots import load_model as load_robot_model
from lfd.worlds.rollout import Outcome, rollout

EVALUATION_SEED = 5
"""Of the random starts of plans that weights are judged by."""
SCENE_STREAM, RUN_STREAM = 7, 8
"""Parts of the seeds of scenes with their people, and of runs."""


@dataclass(frozen=True, kw_only=True)
class CorrectionRecipe:
    """What happens; recorded with every run as `[correct]`."""

    task: str
    """cup, table, laptop or person: what the robot does not know."""
    robot: str = "panda"
    """Robot config."""
    control_hz: int = 100
    """Control steps a second [Hz]: torques are commanded, and pushes noticed, that often."""
    runs: int = 2
    """Ways from start to goal."""
    seed: int = 0
    """Of the scene, of the person, and of noise."""
    duration_s: float = 10.0
    """Time of a way [s]."""
    waypoints: int = 20
    """Of its plan."""
    smoothness: float = 1.0
    """lambda of the planner's prior [s^3/rad^2]."""
    rule: str = "one"
    """How weights learn: one feature at a time, all, or all with confidence."""
    step: float = 4.0
    """beta: by how much a change of a feature's whole range moves its weight, times that range."""
    response: str = "learn"
    """What a push changes: weights and plan (learn), the plan only (deform), or nothing (impedance)."""
    noise_rad: float = 1e-4
    """Standard deviation of the noise on measured joint positions [rad]."""
    noise_rad_s: float = 5e-4
    """The same for measured joint velocities [rad/s]."""

    def check(self, where: str) -> None:
        load_correction_task(self.task)
        for name, known in (("rule", RULES), ("response", RESPONSES)):
            if getattr(self, name) not in known:
                raise UnknownName(f"{name} in {where}:", getattr(self, name), known)
        for name in ("control_hz", "runs", "duration_s", "smoothness", "step"):
            if not 0 < getattr(self, name) < np.inf:
                raise RecipeError(f"{where} {name} = {getattr(self, name)}: must be greater than 0 and finite")
        for name in ("seed", "noise_rad", "noise_rad_s"):
            if getattr(self, name) < 0:
                raise RecipeError(f"{where} {name} = {getattr(self, name)}: must not be negative")


@dataclass(frozen=True)
class Setup:
    """The scene of a recipe, who is in it, and what plans there."""

    placement: Placement
    planner: ArmPlanner
    weights: Float[np.ndarray, "K"]
    """Of a scripted person."""

    def cost(self, weights: Float[np.ndarray, "K"]) -> float:
        """What the plan for some weights costs by the person's: prior less w* . f."""
        plan = self.planner.plan(weights, rng=np.random.default_rng(EVALUATION_SEED))
        return plan.cost + plan.reward - float(self.weights @ plan.features)

    def cosine(self, weights: Float[np.ndarray, "K"], ranges: Float[np.ndarray, "K"]) -> float:
        """Of some weights and the person's, in units of the ranges; 0 for no weights."""
        a, b = weights * ranges, self.weights * ranges
        size = float(np.linalg.norm(a) * np.linalg.norm(b))
        return float(a @ b) / size if size > 0.0 else 0.0


@dataclass
class Run:
    """What happened on one way."""

    success: bool
    updates: list[Update]
    noticed_s: list[float]
    """When pushes were noticed."""
    effort: float
    """Integral of the force, and of the torque over `LEVER_M` [N s]."""
    pushed_s: float
    """Time for which somebody pushed [s]."""
    clipped: int
    """Control steps in which a push was beyond the robot's limit."""


@dataclass
class Pushes:
    """An observer of what a person does."""

    hz: int
    effort: float = 0.0
    pushed_s: float = 0.0

    def begin(self, world: World, observation: Any) -> None:
        """Nothing to open."""

    def step(self, world: World, transition: Transition) -> None:
        push = np.array(list(transition.decision.signals["push"].values()))
        size = float(np.linalg.norm(push[:3]) + np.linalg.norm(push[3:]) / LEVER_M)
        self.effort, self.pushed_s = self.effort + size / self.hz, self.pushed_s + (size > 0) / self.hz

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""


def set_up(recipe: CorrectionRecipe) -> Setup:
    """The scene and the person of a recipe's seed."""
    task, arm = load_correction_task(recipe.task), load_arm(recipe.robot)
    rng = np.random.default_rng([SCENE_STREAM, recipe.seed])
    placement = task.draw_scene(arm, rng)
    planner = ArmPlanner(
        arm,
        placement.scene(arm),
        features=FEATURES,
        waypoints=recipe.waypoints,
        duration_s=recipe.duration_s,
        smoothness=recipe.smoothness,
    )
    return Setup(placement, planner, task.draw_weights(rng))


def start_reward(recipe: CorrectionRecipe) -> LinearReward:
    """What the robot believes before the first push: N(w_0, diag(step / range^2)), whose MAP update is the rule."""
    ranges = RANGE_1 * recipe.duration_s
    weights = load_correction_task(recipe.task).start_weights
    belief = GaussianFactor(weights, np.diag(ranges**2 / recipe.step))
    return LinearReward(
        features=FEATURES,
        weights=weights,
        ranges=ranges,
        robot=recipe.robot,
        waypoints=recipe.waypoints,
        duration_s=recipe.duration_s,
        smoothness=recipe.smoothness,
        method="given",
        covariance=np.diag(recipe.step / ranges**2),
        history=(Change(f"what the robot believed before {recipe.task}", (), tuple(map(float, weights)), belief),),
    )


def learner_of(reward: LinearReward, recipe: CorrectionRecipe) -> PushLearner:
    """What learns from pushes, from a reward on; nobody wants more of any of these features than it has.

    Raises `InputError` for a reward with other features or planner settings.
    """
    for name, wanted in (
        ("features", FEATURES), ("robot", recipe.robot), ("waypoints", recipe.waypoints),
        ("duration_s", recipe.duration_s), ("smoothness", recipe.smoothness),
    ):  # fmt: skip
        if getattr(reward, name) != wanted:
            raise InputError(f"the reward has {name} = {getattr(reward, name)}, corrections are made with {wanted}")
    return PushLearner(
        features=FEATURES,
        weights=np.array(reward.weights),
        ranges=np.array(reward.ranges),
        step=recipe.step,
        rule=recipe.rule,
        upper=np.maximum(0.0, reward.weights),
    )


def make_correction_world(recipe: CorrectionRecipe) -> RobosuiteWorld:
    """The world of a recipe: robosuite's table, and an arm that is given torques."""
    return make_world(TASK, recipe.robot, recipe.control_hz, controller=CONTROLLER)


def correct(
    recipe: CorrectionRecipe,
    setup: Setup,
    learner: PushLearner,
    person: Person,
    world: RobosuiteWorld,
    *,
    out: Path | None = None,
    observers: Callable[[], list[Observer]] = list,
    around: Callable[[Any], Any] = lambda policy: policy,
    progress: Progress = silent,
) -> list[Run]:
    """The runs of a recipe, recorded into the folder `out` if there is one; `learner` has learned afterwards.

    `around` is put around the policy, as `lfd.record.pacing.Paced` is for people.
    """
    used = {"correct": as_table(recipe), "scene": setup.placement.table()}
    if out is not None:
        begin_recordings(out, used, recipe.seed)
    found = []
    with progress("correct", recipe.runs) as bar:
        for number in range(recipe.runs):
            watching: list[Observer] = [pushes := Pushes(recipe.control_hz), *observers()]
            if out is not None:
                watching.append(
                    make_recorder(
                        out, used, policy=CorrectableArm.name, seed=recipe.seed, attempt=number, keep_failures=True
                    )
                )
            run, outcome = _run(recipe, setup, learner, person, world, number, watching, around)
            run.effort, run.pushed_s, run.success = pushes.effort, pushes.pushed_s, outcome.success
            found.append(run)
            bar.advance(note=f"{len(run.noticed_s)} pushes, {'at the goal' if run.success else 'not at the goal'}")
    return found


def _run(
    recipe: CorrectionRecipe,
    setup: Setup,
    learner: PushLearner,
    person: Person,
    world: RobosuiteWorld,
    number: int,
    watching: list[Observer],
    around: Callable[[Any], Any],
) -> tuple[Run, Outcome]:
    """One way from start to goal."""
    rng = np.random.default_rng([RUN_STREAM, recipe.seed, number])
    world.reset(rng)
    start = stand(world, setup.planner.scene.start)
    arm = CorrectableArm(
        world.spec,
        ArmDynamics(load_model(start.model_xml), world.spec.labels["joint_pos"]),
        setup.planner,
        learner,
        response=recipe.response,
        noise=(recipe.noise_rad, recipe.noise_rad_s),
    )
    pushed = PushedArm(arm, person, world, load_robot_model(recipe.robot).push_n)
    outcome = rollout(
        world, around(pushed), watching, rng, horizon=arm.horizon, hold_steps=arm.horizon + 1, start=start
    )
    return Run(outcome.success, arm.updates, arm.notice.begins, 0.0, 0.0, pushed.clipped), outcome


def scripted(recipe: CorrectionRecipe, setup: Setup) -> ScriptedPerson:
    """The recipe's person."""
    force = 0.75 * load_robot_model(recipe.robot).push_n
    return ScriptedPerson(setup.planner, setup.weights, force, recipe.control_hz)


def learned_reward(reward: LinearReward, learner: PushLearner) -> LinearReward:
    """The reward with every push in its history, each as the factor by which its belief moves as the weights did."""
    for number, learned in enumerate(learner.history, start=1):
        change = learned.after - learned.before
        if change.any():
            moved = ", ".join(f for f, x in zip(FEATURES, change, strict=True) if x)
            factor = PushFactor(np.linalg.solve(belief_of(reward).covariance, change))
            reward = updated(reward, factor, f"push {number}, by the rule {learner.rule!r}: {moved}")
    return reward


def weights_by_push(runs: list[Run], first: Float[np.ndarray, "K"]) -> list[Float[np.ndarray, "K"]]:
    """The weights before the first push and after each that was learned from."""
    return [first, *(u.learned.after for run in runs for u in run.updates if u.learned is not None)]


def report_of(
    recipe: CorrectionRecipe, setup: Setup, runs: list[Run], weights: list[Float[np.ndarray, "K"]], *, judged: bool
) -> dict[str, Any]:
    """What happened, as plain numbers; with regret and cosine where the person's weights are known."""
    updates = [update for run in runs for update in run.updates]
    report: dict[str, Any] = {
        "pushes": sum(len(run.noticed_s) for run in runs),
        "reached_goal": sum(run.success for run in runs),
        "runs": len(runs),
        "effort_n_s": sum(run.effort for run in runs),
        "pushed_s": sum(run.pushed_s for run in runs),
        "clipped_steps": sum(run.clipped for run in runs),
        "stopped": sum(not update.found for update in updates),
        "planning_ms": 1e3 * max((update.planning_s for update in updates), default=0.0),
        "weights": [dict(zip(FEATURES, map(float, w), strict=True)) for w in weights],
    }
    if judged:
        best, ranges = setup.cost(setup.weights), RANGE_1 * recipe.duration_s
        report["regret"] = [setup.cost(w) - best for w in weights]
        report["cosine"] = [setup.cosine(w, ranges) for w in weights]
    return report
