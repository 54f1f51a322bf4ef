"""Demonstrations by a planner with known weights, run on the simulated arm and recorded like all others.

Every recording keeps, as its recipe, what it was planned with and the scene that it was planned in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.artifact import check_output
from lfd.core.errors import LfdError, RecipeError
from lfd.core.protocols import Observation, Observer, Progress, Transition, World, WorldState, silent
from lfd.core.recipe import as_table
from lfd.experts.plan_follower import CONTROLLER, PlanFollower
from lfd.loops.cup_scenes import Placement, draw_placement
from lfd.planning.arm_model import load_arm
from lfd.planning.arm_planner import SPREAD_RAD, ArmPlanner, Plan
from lfd.planning.boltzmann import Demonstrator
from lfd.planning.kinematics import Arm
from lfd.record.demonstrations import begin_recordings, make_recorder
from lfd.rewards.arm_features import arm_features
from lfd.rewards.reward_artifact import LinearReward
from lfd.worlds.cameras import load_model
from lfd.worlds.robosuite_world import RobosuiteWorld, make_world
from lfd.worlds.rollout import episode_rng, rollout

TASK, INSTRUCTION = "Lift", "carry the cup past the person and the laptop"
"""The world with robosuite's table; person and laptop are in the recipe, not in the simulation."""
CUBE, ASIDE_M = "cube_joint0", (0.36, -0.36)
"""Lift's cube, and the corner of the table that it is put into: plans know nothing of it."""
TRIES = 50
"""Random deviations that are tried until one touches nothing."""
PROPOSALS = (1000, 4000, 16_000)
"""Of the chains that draw for a Boltzmann demonstrator: longer ones where shorter ones still hang on the optimum."""
REMEMBERED = 0.1
"""Most that a draw may remember of the optimum that its chain began from."""
PLAN_STREAM = 1
"""Part of the seed of plans; scenes have 0."""


@dataclass(frozen=True, kw_only=True)
class PlanRecipe:
    """The `[plan]` table of a file in `datasets/`: a demonstrator that plans."""

    robot: str
    """Robot config, the name of a file in robot_configs/."""
    control_hz: int
    """Control steps a second when the plan is run [Hz]."""
    scenes: int
    """Cup scenes to plan in; places of start, goal, person and laptop are drawn for each."""
    per_scene: int = 1
    """Demonstrations in each scene."""
    seed: int
    """Seed of scenes, plans and noise."""
    features: tuple[str, ...]
    """Features that the demonstrator cares for (`lfd.rewards.ARM_FEATURES`)."""
    weights: tuple[float, ...]
    """How much: reward for each unit of each feature's count."""
    waypoints: int
    """Waypoints of a plan, start and goal among them."""
    duration_s: float
    """Time that a plan takes [s]."""
    smoothness: float
    """lambda of the planner's prior for smooth motion [s^3/rad^2]."""
    starts: int
    """Trajectories that the planner starts from."""
    noise_rad: float
    """Standard deviation in the middle of a smooth random deviation of each joint from the plan [rad]; 0 for none."""
    rationality: float = 0.0
    """beta of a demonstrator who picks trajectories with p ~ exp(-beta cost) [1/cost]; 0 for one who does the best."""

    def check(self, where: str) -> None:
        arm_features(self.features)
        if len(self.weights) != len(self.features):
            raise RecipeError(
                f"{where} has {len(self.weights)} weights for {len(self.features)} features: one for each"
            )
        for key in ("control_hz", "scenes", "per_scene", "starts", "duration_s", "smoothness"):
            if not 0 < getattr(self, key) < np.inf:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must be greater than 0 and finite")
        for key in ("seed", "noise_rad", "rationality"):
            if not 0 <= getattr(self, key) < np.inf:
                raise RecipeError(f"{where} {key} = {getattr(self, key)}: must not be negative, and finite")
        if self.noise_rad and self.rationality:
            raise RecipeError(
                f"{where} has noise_rad = {self.noise_rad} and rationality = {self.rationality}, two ways to deviate "
                "from the optimum; set one of them to 0"
            )

    @classmethod
    def of_reward(cls, reward: LinearReward, **others: Any) -> "PlanRecipe":
        """What plans with a learned reward; `others` are the fields that a reward does not have."""
        return cls(
            robot=reward.robot,
            features=reward.features,
            weights=tuple(map(float, reward.weights)),
            waypoints=reward.waypoints,
            duration_s=reward.duration_s,
            smoothness=reward.smoothness,
            **others,
        )

    def planner(self, arm: Arm, placement: Placement) -> ArmPlanner:
        """The planner in a scene."""
        return ArmPlanner(
            arm,
            placement.scene(arm),
            features=self.features,
            waypoints=self.waypoints,
            duration_s=self.duration_s,
            smoothness=self.smoothness,
        )


@dataclass(frozen=True)
class Planned:
    """What a run of plans did."""

    episodes: int
    failures: int
    """Plans that the arm did not follow to their end."""
    tracking_rad: float
    """Largest distance of a joint from its plan, over all steps of all episodes [rad]."""
    cost: float
    """Mean cost of the plans, -w . f and the prior, before noise."""
    clearance_m: float
    """Smallest distance of a plan to the scene's shapes [m]."""


def draw_scenes(recipe: PlanRecipe) -> list[Placement]:
    """The scenes of a recipe: number i depends on the seed and i alone."""
    arm = load_arm(recipe.robot)
    return [draw_placement(arm, np.random.default_rng([0, recipe.seed, i])) for i in range(recipe.scenes)]


def demonstrate(
    recipe: PlanRecipe,
    scenes: Sequence[Placement],
    out: Path,
    *,
    tables: Mapping[str, Any],
    overwrite: bool = False,
    progress: Progress = silent,
) -> Planned:
    """Plan in each scene, run the plans on the arm and record them into the folder `out`, scene by scene.

    `tables` is the whole recipe file. Raises `LfdError` where the planner finds no way that touches nothing,
    `InputError` for a plan that is too fast for the arm, `OutputError` when `out` exists.
    """
    check_output(out, overwrite=overwrite)
    used = {**tables, "plan": as_table(recipe)}
    world = make_world(TASK, recipe.robot, recipe.control_hz, controller=CONTROLLER)
    world.spec = replace(world.spec, instruction=INSTRUCTION)
    with progress("plan", len(scenes)) as bar:
        planned = []
        for number, placement in enumerate(scenes):
            plan, ways = demonstrations_in(recipe, number, placement)
            planned.append((plan, [PlanFollower(world.spec, way, plan.dt_s) for way in ways]))
            bar.advance()
    begin_recordings(out, used, recipe.seed)
    runs = [(placement, one) for placement, (_, many) in zip(scenes, planned, strict=True) for one in many]
    tracks, failures = [], 0
    with progress("run", len(runs)) as bar:
        for index, (placement, follower) in enumerate(runs):
            record = make_recorder(
                out,
                {**used, "scene": placement.table()},
                policy=follower.name,
                seed=recipe.seed,
                attempt=index,
                keep_failures=True,
            )
            success, off = _run(world, follower, record, episode_rng("record", recipe.seed, index))
            tracks.append(off)
            failures += not success
            bar.advance(note=f"{off:.4f} rad off")
    costs, clearances = ([getattr(plan, key) for plan, _ in planned] for key in ("cost", "clearance"))
    return Planned(len(tracks), failures, max(tracks), float(np.mean(costs)), min(clearances))


def demonstrations_in(
    recipe: PlanRecipe, number: int, placement: Placement
) -> tuple[Plan, list[Float[np.ndarray, "T D"]]]:
    """The plan in scene `number`, and what the demonstrator does there, each time that it demonstrates.

    Raises `LfdError` where the planner finds no way that touches nothing, and where draws cannot be had.
    """
    rng, weights = np.random.default_rng([PLAN_STREAM, recipe.seed, number]), np.array(recipe.weights)
    planner = recipe.planner(load_arm(recipe.robot), placement)
    plan = planner.plan(weights, starts=recipe.starts, rng=rng)
    if plan.collides:
        raise LfdError(f"scene {number}: the best of {recipe.starts} plans touches something; try more starts")
    if not recipe.rationality:
        return plan, [deviate(planner, plan.trajectory, recipe.noise_rad, rng) for _ in range(recipe.per_scene)]
    demonstrator = Demonstrator(planner, weights, recipe.smoothness)
    remembered = 1.0
    for steps in PROPOSALS:
        drawn, chains = demonstrator.draws(
            plan.trajectory, rationality=recipe.rationality, count=recipe.per_scene, steps=steps, rng=rng
        )
        remembered = float(chains.remembered.max())
        if remembered <= REMEMBERED:
            return plan, list(drawn)
    raise LfdError(
        f"scene {number}: after {PROPOSALS[-1]} proposals a draw for rationality = {recipe.rationality} still hangs on "
        f"the optimum ({remembered:.2f} of 1); choose a greater rationality"
    )


def _run(
    world: RobosuiteWorld, follower: PlanFollower, record: Observer, rng: np.random.Generator
) -> tuple[bool, float]:
    """Run a plan on the arm from its start: whether it was followed to its end, and how far the arm was off [rad]."""
    track = Tracking(follower)
    world.reset(rng)
    start = stand(world, follower.reference(np.zeros(1))[0])
    steps = follower.steps
    outcome = rollout(world, follower, [record, track], rng, horizon=steps, hold_steps=steps + 1, start=start)
    return outcome.success, track.largest


def deviate(
    planner: ArmPlanner, trajectory: Float[np.ndarray, "T D"], noise_rad: float, rng: np.random.Generator
) -> Float[np.ndarray, "T D"]:
    """A trajectory with a smooth random deviation that leaves its ends where they are and touches nothing.

    Raises `LfdError` where 50 in a row touch something.
    """
    if noise_rad == 0:
        return trajectory
    for _ in range(TRIES):
        away = planner.random_starts(1, rng)[0] - planner.straight()
        made = np.clip(trajectory + noise_rad / SPREAD_RAD * away, planner.arm.low, planner.arm.high)
        if planner.clearance(made[None])[0] >= 0:
            return made
    raise LfdError(f"{TRIES} deviations of {noise_rad} rad touch something in a row; choose a smaller noise_rad")


def stand(world: RobosuiteWorld, joints: Float[np.ndarray, "D"]) -> WorldState:
    """The state of Lift's world with its arm at rest in a posture [rad], the cube aside; the world is then in it."""
    model = load_model(world.get_state().model_xml)
    qpos = world.sim_state()[1 : 1 + model.nq]  # mjSTATE_INTEGRATION begins with time, qpos
    for name, value in zip(world.spec.labels["joint_pos"], joints, strict=True):
        qpos[model.joint(name).qposadr[0]] = value
    cube = model.joint(CUBE).qposadr[0]
    qpos[cube : cube + 2] = ASIDE_M
    world.show(np.concatenate([[0.0], qpos, np.zeros(model.nv)]))
    world.settle()
    return world.get_state()


class Tracking:
    """An observer that measures how far a follower's arm is from its plan."""

    def __init__(self, follower: PlanFollower):
        self._follower = follower
        self.largest = 0.0
        """[rad]"""

    def begin(self, world: World, observation: Observation) -> None:
        """Nothing to open."""

    def step(self, world: World, transition: Transition) -> None:
        then = (transition.step + 1) / world.spec.control_hz
        away = transition.result.observation["joint_pos"] - self._follower.reference(np.array([then]))[0]
        self.largest = max(self.largest, float(np.abs(away).max()))

    def end(self, success: bool) -> None:
        """Nothing to close."""

    def abort(self) -> None:
        """Nothing to undo."""
