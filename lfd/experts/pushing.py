"""People who push an arm: a scripted one, who wants another trajectory, one at a device, and a recorded one.

A push is a force [N] and a torque [N m] in the world frame at the centre of the gripper.
"""

from collections import deque
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lfd.core.channels import XYZ
from lfd.core.protocols import Decision, Observation, Policy, Verdict
from lfd.experts.device import Device
from lfd.experts.impedance import Reference
from lfd.experts.keys import Word
from lfd.experts.teleoperation import FACING
from lfd.planning.arm_planner import ArmPlanner
from lfd.planning.kinematics import GRIPPER, forward
from lfd.planning.replanning import Rest
from lfd.worlds.robosuite_world import RobosuiteWorld

BODY = "gripper0_right_eef"
"""What people push: robosuite's name of the body at the grip site."""
NAMES = (*(f"force_{axis}" for axis in XYZ), *(f"torque_{axis}" for axis in XYZ))
LEVER_M = 0.15
"""Largest torque is the largest force times this: two hands on the gripper, some centimetres apart."""
REACTION_S = 0.25
"""Time until a person acts on what they see."""
STIFFNESS_N_M, STIFFNESS_N_M_RAD = 200.0, 8.0
"""A person's arm: force for each metre, and torque for each radian that the gripper is from where they want it."""
NOTICED_M, NOTICED_RAD = 0.06, 0.25
"""What is off by more is worth a push."""
ENOUGH = 0.25
"""Share of that below which a person lets go."""
LONGEST_S, REST_S = 2.0, 1.0
"""A push takes no longer; after it a person looks on."""
NOISE = 0.1
"""Standard deviation of a push, as a share of the largest force."""


@runtime_checkable
class Person(Protocol):
    """Somebody who may push the arm."""

    name: str

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode."""
        ...

    def wrench(self, time_s: float, observation: Observation) -> Float[np.ndarray, "6"]:
        """Force [N] and torque [N m] now."""
        ...

    def verdict(self) -> Verdict | None:
        """A word that ends the episode, where one was said."""
        ...


class PushedArm:
    """A policy whose arm a person pushes, in the world that it acts in."""

    def __init__(self, policy: Policy, person: Person, world: RobosuiteWorld, force_limit_n: float):
        """Forces beyond the limit, and torques beyond the limit times `LEVER_M`, are clipped."""
        self.name, self._policy, self._person, self._world = policy.name, policy, person, world
        self._limits = force_limit_n * np.array([1.0, LEVER_M])
        self.clipped = 0
        """Steps in which a push was beyond the limits."""

    def reset(self, rng: np.random.Generator) -> None:
        self._step = 0
        self._policy.reset(rng)
        self._person.reset(rng)

    def act(self, observation: Observation) -> Decision:
        wrench = self._person.wrench(self._step / self._world.spec.control_hz, observation)
        parts = [bounded(part, limit) for part, limit in zip(wrench.reshape(2, 3), self._limits, strict=True)]
        applied = np.concatenate(parts)
        self.clipped += bool((applied != wrench).any())
        self._world.push(BODY, applied)
        self._step += 1
        decision = self._policy.act(observation)
        signals = {**decision.signals, "push": dict(zip(NAMES, map(float, applied), strict=True))}
        return replace(
            decision,
            signals=signals,
            intervention=bool(applied.any()),
            verdict=self._person.verdict() or decision.verdict,
        )


class ScriptedPerson:
    """Somebody with weights of their own, who pushes the arm towards the plan that is best by these.

    They compare the gripper with where it should be by their plan, a quarter of a second late; push like a spring, with
    noise, until it is there or they are tired; and plan anew from where the arm is then.
    """

    name = "scripted"

    def __init__(self, planner: ArmPlanner, weights: Float[np.ndarray, "K"], force_limit_n: float, control_hz: int):
        self._planner, self._weights, self._limit, self._hz = planner, weights, force_limit_n, control_hz
        self._duration_s = planner.dt_s * (planner.waypoints - 1)

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng
        plan = self._planner.plan(self._weights, rng=rng)
        self._wanted = Reference(plan.trajectory, plan.dt_s)
        self._late = round(REACTION_S * self._hz)
        self._seen: deque[np.ndarray] = deque(maxlen=1 + self._late)
        self._pushes, self._began_s, self._rests_until_s = False, 0.0, 0.0
        self.pushes = 0
        """How often they began to push in the episode."""

    def wrench(self, time_s: float, observation: Observation) -> Float[np.ndarray, "6"]:
        self._seen.append(np.stack([observation["joint_pos"], observation["joint_vel"]]))
        if time_s >= self._duration_s or len(self._seen) <= self._late:
            self._pushes = False
            return np.zeros(6)
        away, turn = self._away(time_s - REACTION_S)
        size = max(float(np.linalg.norm(away)) / NOTICED_M, float(np.linalg.norm(turn)) / NOTICED_RAD)
        if not self._pushes and time_s >= self._rests_until_s and size > 1.0:
            self._pushes, self._began_s = True, time_s
            self._bias = self._rng.normal(0.0, NOISE, 6) * self._limit * np.repeat([1.0, LEVER_M], 3)
            self.pushes += 1
        elif self._pushes and (size < ENOUGH or time_s - self._began_s > LONGEST_S):
            self._pushes, self._rests_until_s = False, time_s + REST_S
            self._plan_anew(time_s)
        if not self._pushes:
            return np.zeros(6)
        force = bounded(STIFFNESS_N_M * away + self._bias[:3], self._limit)
        torque = bounded(STIFFNESS_N_M_RAD * turn + self._bias[3:], self._limit * LEVER_M)
        return np.concatenate([force, torque])

    def verdict(self) -> Verdict | None:
        return None

    def _away(self, time_s: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Where the gripper should have been when it was seen, from where it was [m]; how the cup should turn [rad]."""
        both = forward(self._planner.arm, np.stack([self._wanted.at(time_s).position, self._seen[0][0]]))
        wanted, present = both.points[:, GRIPPER]
        return wanted - present, _turn(both.cup_axis[1], both.cup_axis[0])

    def _plan_anew(self, time_s: float) -> None:
        """The best way on from here, by their weights; where there is none they still want the old one."""
        rest = Rest(self._planner, self._duration_s - time_s)
        position, velocity = self._seen[-1]
        warm = self._wanted.positions(rest.times(time_s))
        plan = rest.replan(self._weights, position=position, velocity=velocity, warm=warm)
        if plan is not None:
            self._wanted = Reference(plan.trajectory, plan.dt_s, begins_s=time_s, velocity=velocity)


class DevicePerson:
    """A person at a device: its deflection is the force, its rotation the torque, as they see the arm."""

    def __init__(self, device: Device, frame: str, force_limit_n: float):
        """`frame` is the robot config's: who faces the robot (view) pushes it towards its base with "away"."""
        self.name, self._device, self._limit = device.name, device, force_limit_n
        self._turn = FACING if frame == "view" else np.eye(3)
        self._word: Word | None = None

    def reset(self, rng: np.random.Generator) -> None:
        self._word = None

    def wrench(self, time_s: float, observation: Observation) -> Float[np.ndarray, "6"]:
        state = self._device.read()
        self._word = next((word for word in state.words if word in ENDS), None)
        return self._limit * np.concatenate([self._turn @ state.translation, LEVER_M * self._turn @ state.rotation])

    def verdict(self) -> Verdict | None:
        return None if self._word is None else ENDS[self._word]


class RecordedPerson:
    """The pushes of a recording, again at the same times."""

    def __init__(self, name: str, times: Float[np.ndarray, "N"], wrenches: Float[np.ndarray, "N 6"]):
        self.name, self._times, self._wrenches = name, times, wrenches

    def reset(self, rng: np.random.Generator) -> None:
        """Nothing to begin."""

    def wrench(self, time_s: float, observation: Observation) -> Float[np.ndarray, "6"]:
        at = int(np.searchsorted(self._times, time_s + 1e-6)) - 1
        return self._wrenches[at] if at >= 0 else np.zeros(6)

    def verdict(self) -> Verdict | None:
        return None


ENDS: dict[Word, Verdict] = {
    Word.SUCCESS: Verdict.SUCCESS,
    Word.FAILURE: Verdict.FAILURE,
    Word.DISCARD: Verdict.DISCARD,
}
"""Words that end an episode."""


def bounded(vector: Float[np.ndarray, "3"], limit: float) -> Float[np.ndarray, "3"]:
    """The vector, shortened to a length."""
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)


def _turn(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The smallest rotation vector that turns a unit vector into another [rad]."""
    across = np.cross(one, other)
    sine = float(np.linalg.norm(across))
    return across * (np.arctan2(sine, float(one @ other)) / sine) if sine > 1e-9 else np.zeros(3)
