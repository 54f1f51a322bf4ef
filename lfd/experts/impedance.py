"""A joint impedance controller: the arm follows a reference as if held by springs, and yields when it is pushed.

    tau = K (r - q) + D (rd - qd) + M(q) rdd        beside gravity and Coriolis torques, which robosuite compensates

The springs K are proportional to the joints' largest torques, D = 2 sqrt(K diag M) damps each joint critically.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from lfd.core.errors import InputError
from lfd.core.protocols import WorldSpec

CONTROLLER = "JOINT_TORQUE_FULL"
STIFFNESS_1_RAD = 0.5
"""K as a share of a joint's largest torque: 40 N m/rad in Panda's shoulder."""


@dataclass(frozen=True)
class Posture:
    """Where the joints should be at one time."""

    position: Float[np.ndarray, "D"]
    """[rad]"""
    velocity: Float[np.ndarray, "D"]
    """[rad/s]"""
    acceleration: Float[np.ndarray, "D"]
    """[rad/s^2]"""


class Reference:
    """A joint-space trajectory in time: a cubic spline through waypoints, at rest after its end."""

    def __init__(
        self,
        trajectory: Float[np.ndarray, "T D"],
        dt_s: float,
        *,
        begins_s: float = 0.0,
        velocity: Float[np.ndarray, "D"] | None = None,
    ):
        """`begins_s` is the time of the first waypoint [s], `velocity` that in it [rad/s], 0 without it."""
        still = np.zeros(trajectory.shape[1])
        self.begins_s, self.ends_s = begins_s, begins_s + dt_s * (len(trajectory) - 1)
        times = np.linspace(self.begins_s, self.ends_s, len(trajectory))
        ends: Any = ((1, still if velocity is None else velocity), (1, still))  # the stubs know names only
        self._spline = CubicSpline(times, trajectory, bc_type=ends)

    def at(self, time_s: float) -> Posture:
        """The posture at a time [s]."""
        inside = min(max(time_s, self.begins_s), self.ends_s)
        still = 0.0 if time_s > self.ends_s else 1.0
        return Posture(self._spline(inside), still * self._spline(inside, 1), still * self._spline(inside, 2))

    def positions(self, times: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N D"]:
        """Positions at some times [rad]."""
        return self._spline(np.clip(times, self.begins_s, self.ends_s))


class Impedance:
    """The control law above for one arm."""

    def __init__(self, spec: WorldSpec, full_torque_n_m: Float[np.ndarray, "D"]):
        """`full_torque_n_m` is the torque at full action. Raises `InputError` for a world with another controller."""
        if spec.controller != CONTROLLER:
            raise InputError(
                f"an impedance controller commands torques with {CONTROLLER}, the world has {spec.controller}; "
                f'make_world(..., controller="{CONTROLLER}") gives one'
            )
        self._full, self._stiffness = full_torque_n_m, STIFFNESS_1_RAD * full_torque_n_m

    def action(
        self,
        wanted: Posture,
        q: Float[np.ndarray, "D"],
        qd: Float[np.ndarray, "D"],
        mass: Float[np.ndarray, "D D"],
    ) -> Float[np.ndarray, "D"]:
        """The arm's action in [-1, 1] in a posture q [rad] with velocity qd [rad/s] and mass matrix M(q)."""
        damping = 2.0 * np.sqrt(self._stiffness * np.diag(mass))
        spring = self._stiffness * (wanted.position - q) + damping * (wanted.velocity - qd)
        return np.clip((spring + mass @ wanted.acceleration) / self._full, -1.0, 1.0)
