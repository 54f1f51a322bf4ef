"""From reward weights to arm motion: joint-space waypoints that maximise a linear reward.

The reward is R(tau) = w . f(tau) with the feature counts f of `lfd.rewards.arm_features`, integrals over time. What is
maximised is R less a known prior for smooth motion and penalties for collisions (`lfd.planning.trajectory_costs`):
several starts descend together (`lfd.planning.batched_descent`) in the metric of the terms that are quadratic in the
joints, and the best that touches nothing is the plan. Joint limits are never exceeded. Maxima are local: more starts,
better plans.
"""

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.planning.batched_descent import Minima, minimise
from lfd.planning.kinematics import GRIPPER, SPHERES, Arm, forward
from lfd.planning.scenes import Scene
from lfd.planning.signed_distances import clearance, table_of
from lfd.planning.trajectory_costs import Motion, TrajectoryCost, jerk_squares, rest_to_rest, step_squares
from lfd.rewards.arm_features import arm_features, decision_rows

MARGIN_M = 0.03
"""Distance to shapes below which a penalty begins [m]; it leaves room for what happens between two waypoints."""
STIFFNESS = 300.0
"""kappa of the penalty for collisions at first, where |w| is 1 or less [1/(m^2 s)]; it grows with |w| and, tenfold,
with each round."""
ROUNDS = 4
"""How often the penalties are raised when the best trajectory touches something or misses its goal."""
FINE = 5
"""Parts of a step at whose ends the clearance of a finished plan is looked at."""
SPREAD_RAD = 1.0
"""Standard deviation of random starts in their middle [rad]. Of 0.3, 0.6, 1.0 and 1.5, and of ways through random
postures, this left 8 starts nearest to 200 on the cup scene."""
LONGEST_RAD = 0.5
"""Most that a waypoint moves in an iteration [rad]."""
TOLERANCE = 1e-6
"""Of the cost, relative to max(1, cost)."""
EVALUATIONS = 400
"""Most evaluations in a round."""
GOAL_STIFFNESS = 300.0
"""rho of a free goal at first [1/m^2]."""
GOAL_TOLERANCE_M = 1e-3
"""Distance to the goal up to which a plan has reached it [m]."""


class TouchesSomething(InputError):
    """The arm touches something where a plan should begin or end."""


@dataclass(frozen=True)
class Plan:
    """What the planner found."""

    trajectory: Float[np.ndarray, "T D"]
    """Joint positions at waypoints of equal distance in time [rad]."""
    dt_s: float
    """That distance [s]."""
    features: Float[np.ndarray, "K"]
    """Feature counts, in the features' units times s."""
    reward: float
    """w . f, without prior and penalties."""
    cost: float
    """What was minimised, without penalties: -w . f and the prior."""
    clearance: float
    """Smallest distance of the arm to the scene's shapes on the way, between waypoints too [m]; negative inside."""
    goal_error: float
    """Distance between the gripper and its goal in the end [m]."""
    collides: bool
    """Whether the clearance is negative: such a plan must not be run."""
    converged: bool
    """Whether descent ended at a local optimum, without collision and at the goal."""
    evaluations: int
    """Evaluations of the cost, each for all starts then active."""
    seconds: float
    """Wall time."""


class ArmPlanner:
    """A planner for one arm in one scene, for any weights of some features."""

    def __init__(
        self,
        arm: Arm,
        scene: Scene,
        *,
        features: tuple[str, ...],
        waypoints: int,
        duration_s: float,
        smoothness: float,
        free_goal: bool = False,
    ):
        """`smoothness` is lambda of the prior lambda/2 integral |qdd|^2 dt [s^3/rad^2].

        With `free_goal` only the gripper's place in the end is fixed, not the arm's posture. Raises `UnknownName` for
        a feature that lfd does not know, `InputError` for numbers that make no plan, a scene of another arm, or one in
        which the arm touches something where it starts or ends.
        """
        self.features_used = arm_features(features)
        if waypoints < 4 or not 0 < duration_s < np.inf or not 0 < smoothness < np.inf:
            raise InputError(
                f"waypoints = {waypoints}, duration_s = {duration_s}, smoothness = {smoothness}: a plan has at least 4 "
                "waypoints, and takes a positive time and smoothness"
            )
        for name, posture in (("start", scene.start), ("goal", scene.goal)):
            if posture.shape != arm.low.shape:
                raise InputError(f"the scene's {name} has {posture.shape} joints, {arm.robot!r} has {arm.joints}")
            if not ((arm.low <= posture) & (posture <= arm.high)).all():
                raise InputError(f"the scene's {name} {posture} is beyond the joint limits of {arm.robot!r}")
        self.arm, self.scene, self.waypoints, self.dt_s = arm, scene, waypoints, duration_s / (waypoints - 1)
        self._free_goal, self._shapes = free_goal, table_of(scene.shapes)
        for name, posture in (("start", scene.start), ("goal", scene.goal)):
            free = self.clearance(np.repeat(posture[None, None], 2, axis=1))[0]
            if free < 0:
                raise TouchesSomething(
                    f"in the scene's {name} the arm is {-free:.3f} m inside a shape; move one or the other"
                )
        self._lambda, self._smoothness = smoothness, smoothness * rest_to_rest(waypoints, self.dt_s)
        self._quadratic = {
            "joint_speed": step_squares(waypoints, self.dt_s),
            "joint_jerk": jerk_squares(waypoints, self.dt_s),
        }

    def rows(self, trajectories: Float[np.ndarray, "B T D"], dt_s: float | None = None) -> Float[np.ndarray, "B N K"]:
        """What each of the N = T - 1 decisions of some trajectories adds to the feature counts."""
        wanted = {name for feature in self.features_used for name in feature.channels}
        channels = Motion(self.arm, trajectories, dt_s or self.dt_s).channels(wanted)
        return decision_rows(self.features_used, self.scene.places, channels, dt_s or self.dt_s)

    def features(self, trajectories: Float[np.ndarray, "B T D"]) -> Float[np.ndarray, "B K"]:
        """Feature counts of trajectories of this planner's duration."""
        return self.features_of(trajectories, self.dt_s)

    def features_of(self, trajectories: Float[np.ndarray, "B N D"], dt_s: float) -> Float[np.ndarray, "B K"]:
        """Feature counts of trajectories whose waypoints are `dt_s` apart [s]."""
        return self.rows(trajectories, dt_s).sum(axis=1)

    def onwards(self, start: Float[np.ndarray, "D"], *, waypoints: int, duration_s: float) -> "ArmPlanner":
        """The same planner from another start, with another number of waypoints and duration; raises what it does."""
        return ArmPlanner(
            self.arm,
            replace(self.scene, start=start),
            features=tuple(feature.name for feature in self.features_used),
            waypoints=waypoints,
            duration_s=duration_s,
            smoothness=self._lambda,
            free_goal=self._free_goal,
        )

    def plan(
        self,
        weights: Float[np.ndarray, "K"],
        *,
        warm: Float[np.ndarray, "T D"] | None = None,
        fixed: int = 1,
        starts: int = 8,
        rng: np.random.Generator | None = None,
    ) -> Plan:
        """The best trajectory found from `starts` starts: `warm`, or else the straight way, and random ones.

        The first `fixed` waypoints of `warm` stay as they are: with two of them, (q - qd dt, q), the plan begins in q
        with the velocity qd. `rng` draws the random starts; one start needs none. Raises `InputError` for weights or a
        warm start that do not fit.
        """
        began = perf_counter()
        self._check(weights, warm, starts, rng, fixed)
        first = self.straight() if warm is None else warm
        x = np.repeat(first[None], starts, axis=0)
        if rng is not None and starts > 1:
            x[1:] = self.random_starts(starts - 1, rng)
        x[:, :fixed] = self.scene.start if fixed == 1 else first[:fixed]
        if not self._free_goal:
            x[:, -1] = self.scene.goal
        moving = slice(fixed, self.waypoints if self._free_goal else self.waypoints - 1)
        return self._descend(np.asarray(weights, dtype=float), x, moving, began)

    def straight(self) -> Float[np.ndarray, "T D"]:
        """The straight way in joint space from start to goal, at rest at both ends: the prior's optimum."""
        x = np.zeros((self.waypoints, self.arm.joints))
        x[0], x[-1] = self.scene.start, self.scene.goal
        inner, fixed = slice(1, -1), [0, -1]
        x[inner] = np.linalg.solve(self._smoothness[inner, inner], -self._smoothness[inner][:, fixed] @ x[fixed])
        return x

    def random_starts(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "B T D"]:
        """Smooth random ways about the straight one, within the joint limits: normal, with the prior's covariance."""
        inner = slice(1, -1)
        factor = np.linalg.cholesky(np.linalg.inv(self._smoothness[inner, inner]))
        factor *= SPREAD_RAD / np.linalg.norm(factor[len(factor) // 2])
        x = np.repeat(self.straight()[None], count, axis=0)
        x[:, inner] += factor @ rng.standard_normal((count, self.waypoints - 2, self.arm.joints))
        return np.clip(x, self.arm.low, self.arm.high)

    def clearance(self, trajectories: Float[np.ndarray, "B T D"]) -> Float[np.ndarray, "B"]:
        """Smallest distance of the arm to the scene's shapes along trajectories, `FINE` times a step [m]."""
        part = np.linspace(0.0, 1.0, FINE, endpoint=False)[:, None]
        between = (1 - part) * trajectories[:, :-1, None] + part * trajectories[:, 1:, None]
        fine = np.concatenate([between.reshape(len(between), -1, self.arm.joints), trajectories[:, -1:]], axis=1)
        poses = forward(self.arm, fine.reshape(-1, self.arm.joints))
        free = clearance(poses.points[:, SPHERES:], self.arm.radius[SPHERES:], self._shapes)
        return free.reshape(len(fine), -1).min(axis=1)

    def _descend(self, weights: np.ndarray, x: np.ndarray, moving: slice, began: float) -> Plan:
        cost, inverse_metric = self._cost(weights, len(x)), self._inverse_metric(weights, moving)
        evaluations, rounds = 0, 0
        while True:
            x, found = self._settle(cost, inverse_metric, x, moving)
            evaluations, rounds = evaluations + found.evaluations, rounds + 1
            free, miss = self.clearance(x), self._miss(x)
            error = np.linalg.norm(miss, axis=1)
            touches, misses = free < 0, error > GOAL_TOLERANCE_M
            best = int(np.lexsort([found.value, misses, touches])[0])
            if rounds == ROUNDS or not (touches[best] or misses[best]):
                break
            if touches[best]:
                cost.stiffness *= 10.0
            if cost.multipliers is not None:
                cost.multipliers = cost.multipliers + cost.goal_stiffness * miss
        trajectory = x[best].copy()
        counts = self.features(trajectory[None])[0]
        prior = 0.5 * float(np.einsum("td,ts,sd->", trajectory, self._smoothness, trajectory))
        for array in (trajectory, counts):
            array.setflags(write=False)
        reward = float(weights @ counts)
        return Plan(
            trajectory=trajectory,
            dt_s=self.dt_s,
            features=counts,
            reward=reward,
            cost=prior - reward,
            clearance=float(free[best]),
            goal_error=float(error[best]),
            collides=bool(touches[best]),
            converged=bool(found.converged[best] and not touches[best] and not misses[best]),
            evaluations=evaluations,
            seconds=perf_counter() - began,
        )

    def _settle(
        self, cost: TrajectoryCost, inverse_metric: np.ndarray, whole: np.ndarray, moving: slice
    ) -> tuple[Float[np.ndarray, "B T D"], Minima]:
        """Local minima of the cost from some trajectories, whose fixed ends stay."""

        def of_moving(part: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            trajectories = whole[rows]
            trajectories[:, moving] = part
            value, gradient = cost(trajectories, rows)
            return value, np.ascontiguousarray(gradient[:, moving])

        found = minimise(
            of_moving,
            whole[:, moving],
            low=self.arm.low,
            high=self.arm.high,
            inverse_metric=inverse_metric,
            longest=LONGEST_RAD,
            tolerance=TOLERANCE,
            evaluations=EVALUATIONS,
        )
        settled = whole.copy()
        settled[:, moving] = found.x
        return settled, found

    def _cost(self, weights: np.ndarray, rows: int) -> TrajectoryCost:
        """The cost at first, before penalties are raised."""
        scale = max(1.0, float(np.linalg.norm(weights)))
        cost = TrajectoryCost(
            self.arm,
            self.scene.places,
            self.features_used,
            weights,
            dt_s=self.dt_s,
            smoothness=self._smoothness,
            shapes=self._shapes,
            margin_m=MARGIN_M,
            stiffness=STIFFNESS * scale,
        )
        if self._free_goal:
            cost.multipliers, cost.goal_stiffness = np.zeros((rows, 3)), GOAL_STIFFNESS * scale
        return cost

    def _inverse_metric(self, weights: np.ndarray, moving: slice) -> Float[np.ndarray, "M M"]:
        """Inverse Hessian, for each joint, of the prior and of those features that are quadratic in the joints."""
        metric = self._smoothness.copy()
        for feature, weight in zip(self.features_used, weights, strict=True):
            if weight < 0 and feature.name in self._quadratic:
                metric -= 2.0 * weight * self._quadratic[feature.name]
        return np.linalg.inv(metric[moving, moving])

    def _miss(self, x: np.ndarray) -> Float[np.ndarray, "B 3"]:
        """Where the gripper ends, from its goal [m]."""
        if not self._free_goal:
            return np.zeros((len(x), 3))
        return forward(self.arm, x[:, -1]).points[:, GRIPPER] - self.scene.places.goal

    def _check(
        self,
        weights: np.ndarray,
        warm: np.ndarray | None,
        starts: int,
        rng: np.random.Generator | None,
        fixed: int,
    ) -> None:
        names = ", ".join(feature.name for feature in self.features_used)
        if np.shape(weights) != (len(self.features_used),) or not np.isfinite(weights).all():
            raise InputError(f"the weights are {weights}; give one finite number for each of {names}")
        shape = self.waypoints, self.arm.joints
        if warm is not None and (warm.shape != shape or not np.isfinite(warm).all()):
            raise InputError(f"the warm start has shape {warm.shape} or is not finite; give one of shape {shape}")
        if starts < 1 or (starts > 1 and rng is None):
            raise InputError(f"starts = {starts}: give at least one start, and an rng for more than one")
        if not 1 <= fixed <= self.waypoints - 2 or (fixed > 1 and warm is None):
            raise InputError(
                f"fixed = {fixed}: of {self.waypoints} waypoints 1 to {self.waypoints - 2} can stay as they are in warm"
            )
