"""An arm that carries out its plan like a spring, notices when it is pushed, learns what was meant, and plans anew.

At every control step: what the arm measures -> the torque of a push (`lfd.planning.external_torque`) -> is it one? ->
while it lasts, the rest of the plan is deformed to where the arm is pushed (`lfd.planning.deform`); when it ends, what
that says of the weights (`lfd.reward_learning.learning_from_pushes`), and a new plan from here
(`lfd.planning.replanning`) -> impedance control towards it (`lfd.experts.impedance`).
"""

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from jaxtyping import Float

from lfd.core.errors import LfdError, UnknownName
from lfd.core.protocols import Decision, Observation, Verdict, WorldSpec
from lfd.experts.grippers import CLOSE
from lfd.experts.impedance import Impedance, Reference
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.deform import deform, deformation_shape
from lfd.planning.external_torque import ArmDynamics, MomentumObserver
from lfd.planning.kinematics import GRIPPER, forward
from lfd.planning.replanning import Rest
from lfd.reward_learning.learning_from_pushes import Learned, PushLearner

RESPONSES = ("learn", "deform", "impedance")
"""What a push changes: the weights and with them the plan; the plan only; nothing."""
THRESHOLD_N_M = 1.5
"""Torque at any joint from which on it is a push. Dry friction stays below a tenth of it."""
QUIET_S = 0.1
"""A push is over when the torque was below half the threshold for so long."""
EVERY_S = 0.25
"""Time between deformations while a push lasts, and between tries to plan where the arm was stopped."""
SETTLED_S = 0.2
"""From the start on, in which the observer settles and nothing counts as a push."""
NEAR_M = 0.03
"""Distance of the gripper to the goal up to which the task is done."""
GRACE_S = 0.5
"""Time after the plan's end to get there."""
STOP_S = 0.4
"""Time in which the arm comes to rest where no plan is found."""
PATH = 20
"""Points of a path that is recorded."""


@dataclass(frozen=True)
class Update:
    """What planning anew did."""

    learned: Learned | None
    """None where nothing is learned from pushes."""
    planning_s: float
    """Wall time of planning anew."""
    found: bool
    """Whether there was a way on; else the arm stops."""


@dataclass
class PushNotice:
    """Whether somebody is pushing, from torques that come one by one."""

    dt_s: float
    is_pushed: bool = False
    begins: list[float] = field(default_factory=list)
    """When pushes were noticed [s]."""
    _quiet_s: float = 0.0

    def update(self, time_s: float, torque: Float[np.ndarray, "D"]) -> bool:
        """Take a torque in; whether a push has just ended."""
        size = float(np.abs(torque).max())
        self._quiet_s = 0.0 if size > 0.5 * THRESHOLD_N_M else self._quiet_s + self.dt_s
        if not self.is_pushed and size > THRESHOLD_N_M and time_s > SETTLED_S:
            self.is_pushed = True
            self.begins.append(time_s)
        elif self.is_pushed and self._quiet_s > QUIET_S:
            self.is_pushed = False
            return True
        return False


@dataclass
class Correction:
    """A push, as long as it lasts."""

    begins_s: float
    before: Reference
    """What the arm followed when it began."""
    positions: list[Float[np.ndarray, "D"]] = field(default_factory=list)
    """Measured since then [rad]."""
    torques: list[Float[np.ndarray, "D"]] = field(default_factory=list)
    """Of the push [N m]."""


class CorrectableArm:
    """The policy above for one arm in one scene."""

    name = "correctable_arm"

    def __init__(
        self,
        spec: WorldSpec,
        dynamics: ArmDynamics,
        planner: ArmPlanner,
        learner: PushLearner,
        *,
        response: str = "learn",
        starts: int = 8,
        noise: tuple[float, float] = (0.0, 0.0),
    ):
        """`planner` plans the whole motion with the learner's weights; `noise` is that of the arm's measured positions
        [rad] and velocities [rad/s].

        Raises `UnknownName` for another response, and what `Impedance` raises; `reset` raises `LfdError` where no plan
        is found that touches nothing.
        """
        if response not in RESPONSES:
            raise UnknownName("response to pushes", response, RESPONSES)
        self._spec, self._dynamics, self._planner = spec, dynamics, planner
        self.learner = learner
        self._response, self._starts, self._noise = response, starts, noise
        self._impedance = Impedance(spec, planner.arm.torque_n_m)
        self._dt_s = 1.0 / spec.control_hz
        self.duration_s = planner.dt_s * (planner.waypoints - 1)
        """Of the motion [s]."""
        self.horizon = round((self.duration_s + GRACE_S) * spec.control_hz)
        """Control steps that it takes."""

    def reset(self, rng: np.random.Generator) -> None:
        self._rng, self._step, self._next_s = rng, 0, 0.0
        self._observer = MomentumObserver(self._dynamics, self._dt_s)
        self.notice, self.updates = PushNotice(self._dt_s), list[Update]()
        plan = self._planner.plan(self.learner.weights, starts=self._starts, rng=rng)
        if plan.collides:
            raise LfdError(f"the best of {self._starts} plans touches something; choose another --seed")
        self._reference = Reference(plan.trajectory, plan.dt_s)
        self._is_stopped = False
        self._correction: Correction | None = None
        self._paths = {"planned_path": self._path(plan.trajectory)}

    def act(self, observation: Observation) -> Decision:
        now = self._step * self._dt_s
        q = observation["joint_pos"] + self._rng.normal(0.0, self._noise[0], self._planner.arm.joints)
        qd = observation["joint_vel"] + self._rng.normal(0.0, self._noise[1], self._planner.arm.joints)
        torque = self._observer.update(q, qd, observation["joint_effort"])
        has_ended = self.notice.update(now, torque)
        if self._response != "impedance":
            self._answer(now, q, qd, torque, has_ended=has_ended)
        mass = self._dynamics.mass(q)
        arm = self._impedance.action(self._reference.at(now + 0.5 * self._dt_s), q, qd, mass)
        action = np.full(len(self._spec.action_low), CLOSE)
        action[: len(arm)] = arm
        self._step += 1
        return Decision(action, verdict=self._verdict(observation), signals=self._signals(torque))

    def _answer(
        self,
        now: float,
        q: Float[np.ndarray, "D"],
        qd: Float[np.ndarray, "D"],
        torque: Float[np.ndarray, "D"],
        *,
        has_ended: bool,
    ) -> None:
        """Yield while somebody pushes; when they let go, learn from where they took the arm, and plan anew."""
        is_late = self.duration_s - now < 2 * self._planner.dt_s
        if self.notice.is_pushed:
            if self._correction is None:
                self._correction = Correction(now, self._reference)
            self._correction.positions.append(q)
            self._correction.torques.append(torque)
            if now >= self._next_s and not is_late:
                self._yield(now, q, qd, self._correction.before)
        elif has_ended and self._correction is not None:
            correction, self._correction = self._correction, None
            if self._response == "learn" and not is_late:
                self._learn(now, q, qd, correction)
        elif self._is_stopped and now >= self._next_s and not is_late:
            self._plan_anew(now, q, qd, self._reference.positions(self._rest(now).times(now)))

    def _yield(
        self, now: float, q: Float[np.ndarray, "D"], qd: Float[np.ndarray, "D"], before: Reference
    ) -> Float[np.ndarray, "N D"]:
        """Follow the rest of the plan, deformed to where the arm is pushed."""
        self._next_s = now + EVERY_S
        rest = self._rest(now)
        planned = before.positions(rest.times(now))
        deformed = self._deformed(planned, q - planned[0])
        self._paths = {"planned_path": self._path(planned), "deformed_path": self._path(deformed)}
        self._reference = Reference(np.concatenate([q[None], deformed[1:]]), rest.dt_s, begins_s=now, velocity=qd)
        return deformed

    def _learn(
        self, now: float, q: Float[np.ndarray, "D"], qd: Float[np.ndarray, "D"], correction: "Correction"
    ) -> None:
        """tau_R is the plan since the push began; tau_H is what was measured until now, and the deformed rest."""
        deformed = self._yield(now, q, qd, correction.before)
        since, ahead = Rest(self._planner, self.duration_s - correction.begins_s), self._rest(now)
        times = since.times(correction.begins_s)
        planned = correction.before.positions(times)
        known = np.concatenate(
            [np.linspace(correction.begins_s, now, len(correction.positions) + 1)[:-1], ahead.times(now)]
        )
        ways = np.concatenate([correction.positions, deformed])
        corrected = np.stack([np.interp(times, known, joint) for joint in ways.T], axis=1)
        push = np.mean(correction.torques, axis=0)
        self._plan_anew(now, q, qd, deformed, self.learner.learn(planned, corrected, push, since.features))

    def _deformed(self, planned: Float[np.ndarray, "N D"], away: Float[np.ndarray, "D"]) -> Float[np.ndarray, "N D"]:
        """The rest, smoothly to the goal, and no farther from the plan than the arm was pushed."""
        length = len(planned) - 1
        scale = 1.0 / float(deformation_shape(length).max())
        way = deform(planned, index=0, push=away, length=length, scale=scale)
        return np.clip(way, self._planner.arm.low, self._planner.arm.high)

    def _plan_anew(
        self,
        now: float,
        q: Float[np.ndarray, "D"],
        qd: Float[np.ndarray, "D"],
        warm: Float[np.ndarray, "N D"],
        learned: Learned | None = None,
    ) -> None:
        """A plan from here with the present weights; where there is none, the arm stops, and tries again."""
        self._next_s = now + EVERY_S
        rest = self._rest(now)
        began = perf_counter()
        plan = rest.replan(self.learner.weights, position=q, velocity=qd, warm=warm)
        self.updates.append(Update(learned, perf_counter() - began, plan is not None))
        if plan is None:
            self._is_stopped = True
            self._reference = Reference(np.stack([q, q + 0.5 * STOP_S * qd]), STOP_S, begins_s=now, velocity=qd)
            return
        self._is_stopped = False
        self._reference = Reference(plan.trajectory, plan.dt_s, begins_s=now, velocity=qd)
        self._paths["new_path"] = self._path(plan.trajectory)

    def _rest(self, now: float) -> Rest:
        return Rest(self._planner, max(self.duration_s - now, 2 * self._planner.dt_s))

    def _path(self, trajectory: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "P 3"]:
        """The gripper's way along a trajectory [m]."""
        times = np.linspace(0.0, 1.0, PATH)
        seen = np.linspace(0.0, 1.0, len(trajectory))
        joints = np.stack([np.interp(times, seen, joint) for joint in trajectory.T], axis=1)
        return forward(self._planner.arm, joints).points[:, GRIPPER]

    def _signals(self, torque: Float[np.ndarray, "D"]) -> dict[str, dict[str, float]]:
        names = self._spec.labels["joint_pos"]
        signals = {
            "external_torque": dict(zip(names, map(float, torque), strict=True)),
            "weights": dict(zip(self.learner.features, map(float, self.learner.weights), strict=True)),
        }
        for name, path in self._paths.items():  # only where there are new ones
            signals[name] = {
                f"{axis}{i}": float(x) for i, row in enumerate(path) for axis, x in zip("xyz", row, strict=True)
            }
        self._paths = {}
        return signals

    def _verdict(self, observation: Observation) -> Verdict | None:
        if self._step < self.horizon:
            return None
        away = np.linalg.norm(observation["ee_pos"] - self._planner.scene.places.goal)
        return Verdict.SUCCESS if away <= NEAR_M else Verdict.FAILURE
