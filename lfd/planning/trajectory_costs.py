"""What a batch of joint trajectories costs under a linear reward, and the exact gradient.

    cost(tau) = -w . f(tau) + lambda/2 sum_t dt |qdd_t|^2 + kappa sum_t dt c(q_t) + mu . e + rho/2 |e|^2

f are the feature counts of `lfd.rewards.arm_features`; qdd the joints' accelerations by second differences, with the
arm at rest before and after, which is what holds a trajectory together (the smoothness of CHOMP, Zucker et al. 2013);
c the collision penalty of `signed_distances` at the waypoints; e the gripper's distance to its goal in the end, where
that is not a fixed configuration (an augmented Lagrangian with multipliers mu).
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from lfd.planning.kinematics import ELBOW, GRIPPER, SPHERES, Arm, forward, gravity, pull_back
from lfd.planning.signed_distances import collision_penalty
from lfd.rewards.arm_features import STATE, ArmFeature, Places

Trajectories = Float[np.ndarray, "B T D"]


class Motion:
    """The channels of B trajectories of an arm, dt apart, and the way back from their slopes to the joints'."""

    def __init__(self, arm: Arm, trajectories: Trajectories, dt_s: float):
        self._arm, self._joints, self._dt_s = arm, trajectories, dt_s
        self._shape = trajectories.shape[:2]
        self._poses = forward(arm, trajectories.reshape(-1, trajectories.shape[2]))
        self._torque_slopes: np.ndarray | None = None

    @property
    def spheres(self) -> Float[np.ndarray, "N P 3"]:
        """Centres of the spheres that cover the arm, at all N = B T waypoints [m]."""
        return self._poses.points[:, SPHERES:]

    def channels(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Some of the channels of `lfd.rewards.arm_features.CHANNELS`."""
        return {name: self._channel(name) for name in names}

    def gradient(
        self, slopes: Mapping[str, np.ndarray], sphere_slopes: Float[np.ndarray, "N P 3"] | None
    ) -> Trajectories:
        """Gradient of a cost with respect to the waypoints, from its slopes along channels and spheres."""
        points, cup = np.zeros_like(self._poses.points), np.zeros_like(self._poses.cup_axis)
        by_waypoint = points.reshape(*self._shape, -1, 3)
        total = np.zeros_like(self._joints)
        if sphere_slopes is not None:
            points[:, SPHERES:] = sphere_slopes
        for name, slope in slopes.items():
            match name:
                case "joints":
                    total += slope
                case "gripper":
                    by_waypoint[:, :, GRIPPER] += slope
                case "elbow":
                    by_waypoint[:, :, ELBOW] += slope
                case "cup_axis":
                    cup += slope.reshape(cup.shape)
                case "gripper_velocity":
                    _spread(slope / self._dt_s, by_waypoint[:, :, GRIPPER])
                case "joint_velocity":
                    _spread(slope / self._dt_s, total)
                case "joint_jerk":
                    total += _jerk_matrix(self._shape[1]).T @ slope / self._dt_s**3
                case "holding_torque":
                    assert self._torque_slopes is not None
                    pull = (slope / self._arm.torque_n_m).reshape(-1, self._arm.joints, 1)
                    total += (self._torque_slopes @ pull).reshape(total.shape)
        return total + pull_back(self._arm, self._poses, points, cup).reshape(total.shape)

    def _channel(self, name: str) -> np.ndarray:
        match name:
            case "joints":
                return self._joints
            case "gripper":
                return self._point(GRIPPER)
            case "elbow":
                return self._point(ELBOW)
            case "cup_axis":
                return self._poses.cup_axis.reshape(*self._shape, 3)
            case "gripper_velocity":
                return np.diff(self._point(GRIPPER), axis=1) / self._dt_s
            case "joint_velocity":
                return np.diff(self._joints, axis=1) / self._dt_s
            case "joint_jerk":
                return _jerk_matrix(self._shape[1]) @ self._joints / self._dt_s**3
        assert name == "holding_torque", name
        torque, self._torque_slopes = gravity(self._arm, self._poses)
        return torque.reshape(self._joints.shape) / self._arm.torque_n_m

    def _point(self, place: int) -> Float[np.ndarray, "B T 3"]:
        return self._poses.points.reshape(*self._shape, -1, 3)[:, :, place]


class TrajectoryCost:
    """The cost above for one w: a function of trajectories and of the rows of a batch that they belong to."""

    def __init__(
        self,
        arm: Arm,
        places: Places,
        features: Sequence[ArmFeature],
        weights: Float[np.ndarray, "K"],
        *,
        dt_s: float,
        smoothness: Float[np.ndarray, "T T"],
        shapes: Float[np.ndarray, "M 10"],
        margin_m: float,
        stiffness: float,
    ):
        """`smoothness` is the matrix S of the second term as 1/2 sum over joints of q . S q."""
        self._arm, self._places, self._dt_s, self._smoothness = arm, places, dt_s, smoothness
        self._used = [(feature, weight) for feature, weight in zip(features, weights, strict=True) if weight != 0.0]
        self._wanted = {name for feature, _ in self._used for name in feature.channels}
        self._shapes, self._margin, self.stiffness = shapes, margin_m, stiffness
        self.multipliers: Float[np.ndarray, "B 3"] | None = None
        """mu of each row; None where the goal is a fixed configuration."""
        self.goal_stiffness = 0.0
        """rho [1/m^2]."""

    def __call__(
        self, trajectories: Trajectories, rows: Int[np.ndarray, "B"]
    ) -> tuple[Float[np.ndarray, "B"], Trajectories]:
        """Costs and their gradients with respect to every waypoint, the fixed ones included."""
        motion, dt = Motion(self._arm, trajectories, self._dt_s), self._dt_s
        channels = motion.channels(self._wanted | ({"gripper"} if self.multipliers is not None else set()))
        weighted = self._smoothness @ trajectories
        cost = 0.5 * np.einsum("btd,btd->b", trajectories, weighted)
        slopes: dict[str, np.ndarray] = {}
        for feature, weight in self._used:
            value, along = feature.function(self._places, *(channels[name] for name in feature.channels))
            quadrature = np.full(value.shape[1], -weight * dt)
            if feature.rows == STATE:
                quadrature[[0, -1]] *= 0.5
            cost += value @ quadrature
            for name, slope in zip(feature.channels, along, strict=True):
                pull = quadrature[:, None] * slope
                slopes[name] = slopes[name] + pull if name in slopes else pull
        if self.multipliers is not None:
            pull = np.zeros_like(channels["gripper"])
            miss = channels["gripper"][:, -1] - self._places.goal
            multipliers = self.multipliers[rows]
            cost += np.einsum("bi,bi->b", miss, multipliers + 0.5 * self.goal_stiffness * miss)
            pull[:, -1] = multipliers + self.goal_stiffness * miss
            slopes["gripper"] = slopes["gripper"] + pull if "gripper" in slopes else pull
        penalty, sphere_slopes = collision_penalty(
            motion.spheres, self._arm.radius[SPHERES:], self._shapes, self._margin
        )
        cost += self.stiffness * dt * penalty.reshape(len(cost), -1).sum(axis=1)
        return cost, weighted + motion.gradient(slopes, self.stiffness * dt * sphere_slopes)


def rest_to_rest(waypoints: int, dt_s: float) -> Float[np.ndarray, "T T"]:
    """S with q . S q = sum_t dt qdd_t^2, qdd by second differences with q_{-1} = q_0 and q_T = q_{T-1}."""
    rise = np.diff(np.eye(waypoints), axis=0)
    bend = np.diff(np.concatenate([np.zeros((1, waypoints)), rise, np.zeros((1, waypoints))]), axis=0)
    return bend.T @ bend / dt_s**3


def step_squares(waypoints: int, dt_s: float) -> Float[np.ndarray, "T T"]:
    """Q with q . Q q = sum of dt qd^2 over the steps."""
    rise = np.diff(np.eye(waypoints), axis=0)
    return rise.T @ rise / dt_s


def jerk_squares(waypoints: int, dt_s: float) -> Float[np.ndarray, "T T"]:
    """Q with q . Q q = sum of dt qddd^2 over the steps but the first and last."""
    jerk = _jerk_matrix(waypoints)
    return jerk.T @ jerk / dt_s**5


def _jerk_matrix(waypoints: int) -> Float[np.ndarray, "N T"]:
    """Third differences, in the row of the step in their middle; 0 for the first and last step."""
    matrix = np.zeros((waypoints - 1, waypoints))
    matrix[1:-1] = np.diff(np.eye(waypoints), n=3, axis=0)
    return matrix


def _spread(slope: np.ndarray, out: np.ndarray) -> None:
    """Add the gradient of something whose slopes along the differences of `out`'s rows are `slope`."""
    out[:, 1:] += slope
    out[:, :-1] -= slope
