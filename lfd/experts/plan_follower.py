"""A policy that moves an arm along a joint-space plan, through robosuite's JOINT_POSITION controller.

The controller turns an action u in [-1, 1] into a goal g = q + RANGE u, q where the joints are now, and accelerates by
omega^2 (g - q) - 2 omega qd until the next action (robosuite's gains, compensated for inertia and gravity). With

    g = r + 2 rd / omega + rdd / omega^2 + integral

the error e = r - q follows e'' + 2 omega e' + omega^2 e = 0, whatever the reference r does. Between two actions g stays
as it is, so r is that of the middle of the step; the integral takes up the joints' friction, which nothing compensates.
"""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from lfd.core.errors import InputError
from lfd.core.protocols import Decision, Observation, Verdict, WorldSpec
from lfd.experts.reaching import CLOSE

CONTROLLER = "JOINT_POSITION"
RANGE_RAD = 0.05
"""Change of the goal at full action [rad]."""
OMEGA = np.sqrt(50.0)
"""Of the controller, critically damped [1/s]; robosuite's kp is its square."""
SPEED_RAD_S = 0.16
"""What a joint keeps up at full action, where a step is 0.05 s: omega RANGE_RAD / 2, less 9% for the goal that stays
behind during the step."""
INTEGRAL = 1.0
"""Gain of the integral [1/s]."""
ARRIVED_RAD = 0.02
"""Largest error of a joint with which the plan counts as followed to its end [rad]."""


class PlanFollower:
    """Follows `trajectory`, joint positions [rad] dt_s apart, from a start there, with the gripper closed.

    Between waypoints the reference is a cubic spline, at rest at both ends. The episode ends with the plan: in success
    if every joint is where it should be. Raises `InputError` for a world with another controller, a plan for another
    arm, and one that is too fast for the controller.
    """

    name = "plan_follower"

    def __init__(self, spec: WorldSpec, trajectory: Float[np.ndarray, "T D"], dt_s: float):
        joints = len(spec.labels["joint_pos"])
        if spec.controller != CONTROLLER:
            raise InputError(
                f"plans are followed with {CONTROLLER}, the world has {spec.controller}; "
                f'make_world(..., controller="{CONTROLLER}") gives one'
            )
        if trajectory.shape[1] != joints:
            raise InputError(f"the plan moves {trajectory.shape[1]} joints, {spec.robot!r} has {joints}")
        self._hz, self._size = spec.control_hz, len(spec.action_low)
        self._joints = joints
        self.duration_s = dt_s * (len(trajectory) - 1)
        """Of the plan [s]."""
        self.steps = round(self.duration_s * spec.control_hz)
        """Control steps that it takes."""
        self._reference = CubicSpline(dt_s * np.arange(len(trajectory)), trajectory, bc_type="clamped")
        times = np.arange(self.steps) / spec.control_hz
        speed = np.abs(self._reference(times, 1)).max(axis=0)
        if speed.max() > SPEED_RAD_S:
            least = self.duration_s * speed.max() / SPEED_RAD_S
            raise InputError(
                f"the plan moves {spec.labels['joint_pos'][int(speed.argmax())]} at up to {speed.max():.2f} rad/s, "
                f"{CONTROLLER} keeps up with {SPEED_RAD_S}; let it take {np.ceil(least):.0f} s or more"
            )

    def reference(self, times: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N D"]:
        """Where the joints should be at some times since the start [s]: [rad], at rest after the end."""
        return self._reference(np.minimum(times, self.duration_s))

    def reset(self, rng: np.random.Generator) -> None:
        self._step = 0
        self._integral = np.zeros(self._joints)

    def act(self, observation: Observation) -> Decision:
        now, middle = self._step / self._hz, min((self._step + 0.5) / self._hz, self.duration_s)
        error = self._reference(now) - observation["joint_pos"]
        self._integral += INTEGRAL * error / self._hz
        goal = self._reference(middle) + 2 * self._reference(middle, 1) / OMEGA + self._reference(middle, 2) / OMEGA**2
        action = np.full(self._size, CLOSE)
        action[: self._joints] = np.clip((goal + self._integral - observation["joint_pos"]) / RANGE_RAD, -1.0, 1.0)
        self._step += 1
        verdict = None
        if self._step >= self.steps:
            verdict = Verdict.SUCCESS if np.abs(error).max() <= ARRIVED_RAD else Verdict.FAILURE
        return Decision(action, verdict=verdict)
