"""Robots that drive among people: one planner, with what it takes people for as an option (chapter 10.6).

    obstacle   they keep their speed, whatever the robot does, and so does who follows them
    known      they have one theta, given: u_H* = argmax R_H(u_R, u_H, theta)
    passive    theta is one of some types: argmax sum_theta b(theta) R_goal(u_R, u_H*(theta)), b updated by what is seen
    active     the same, with information: argmax I(b, u_R) + lambda(t) sum_theta b(theta) R_goal

The person of several types is one follower, whose controls are those of all types one after the other: their rewards
add up, and the expectation over theta is the robot's reward of the whole. I is the sum of what is expected of the
person's next choice at each step of the plan, at least the information of all of them together, since choices are
independent given theta. lambda(t) = lambda_0 exp(t / tau): first ask, then go.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Decision, Observation
from lfd.interaction.driving_model import (
    GOALS,
    PERSON_HIGH,
    PERSON_LOW,
    STEP_S,
    TYPES,
    Situation,
    before,
    by_controls,
    goal_reward,
    hardest_braking,
    person_derivatives,
    person_reward,
    seen_from,
)
from lfd.interaction.driving_people import ACCELERATIONS, choice_rewards, choices_now
from lfd.interaction.information import information_gain
from lfd.interaction.intent import IntentBelief
from lfd.interaction.receding_horizon import Limits, RecedingHorizon
from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, Car, DrivingScene, seen_cars, seen_second

KINDS = ("obstacle", "known", "passive", "active")
STILL = 1e-6
"""Differences of speed that count as none [m/s]."""


@dataclass(frozen=True, kw_only=True)
class DriverOptions:
    """What a robot at the wheel is like."""

    kind: str
    """obstacle, known, passive or active."""
    assumed: str = "aggressive"
    """The type that a `known` person is taken for."""
    horizon: int = 5
    """Steps of the plan, of half a second each."""
    gradients: int = 4
    """Gradients for each plan."""
    difference: float = 0.0
    """Step of finite differences in the implicit gradient's place; 0 for the implicit one."""
    rationality: float = 0.3
    """Of the people, as the robot believes."""
    goal_weight: float = 0.05
    """lambda_0 of the active robot."""
    patience_s: float = 2.0
    """tau of the active robot [s]."""
    learned: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """Types with the theta that was learned for them (`lfd.interaction.person_reward`), in place of the known one."""

    @property
    def theta(self) -> dict[str, tuple[float, ...]]:
        """Of each type, as the robot believes."""
        return TYPES | dict(self.learned)

    def check(self) -> None:
        """Raise `UnknownName` for another kind or type, `InputError` for numbers out of range."""
        if self.kind not in KINDS:
            raise UnknownName("robot kind", self.kind, KINDS)
        for name in (self.assumed, *dict(self.learned)):
            if name not in TYPES:
                raise UnknownName("type of person", name, TYPES)
        for name in ("horizon", "rationality", "goal_weight", "patience_s"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} = {getattr(self, name)}: give a number above 0")


class InteractiveDriver:
    """The robot; its decisions carry the belief as signals, where it has one."""

    def __init__(self, scene: DrivingScene, control_hz: int, options: DriverOptions):
        options.check()
        self.name, self._scene, self._dt, self._options = options.kind, scene, 1.0 / control_hz, options
        names = [options.assumed] if options.kind in ("known", "obstacle") else sorted(TYPES)
        self._names = tuple(names)
        self._theta = torch.tensor([options.theta[name] for name in names], dtype=torch.float64)
        bounds = (torch.tensor(np.tile(end, options.horizon)) for end in (ACTION_LOW, ACTION_HIGH))
        low, high = bounds
        self._low, self._high = low, high
        self.planner = RecedingHorizon(
            Limits(
                robot=(low, high), person=(PERSON_LOW, PERSON_HIGH), gradients=options.gradients,
                difference=options.difference,
            )
        )  # fmt: skip

    @property
    def belief(self) -> Mapping[str, float]:
        """Probability of each type."""
        return MappingProxyType(dict(zip(self._names, self._belief.probabilities.tolist(), strict=True)))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode; nothing is drawn."""
        del rng
        self.planner.forget()
        self._belief = IntentBelief(self._names, torch.ones(len(self._names)))
        self._before: tuple[Situation, np.ndarray] | None = None
        self._looked: tuple[Situation, Tensor, tuple[np.ndarray, np.ndarray]] | None = None
        self._time = 0.0

    def act(self, observation: Observation) -> Decision:
        now = Situation(self._scene, *seen_cars(observation), seen_second(observation))
        if self._before is not None and len(self._names) > 1:
            self._belief = self._belief.updated(self._log_likelihood(now.person))
        size = self._options.horizon * len(self._names)
        plan = self.planner.plan(
            lambda u_robot, u_human: self._robot_reward(now, u_robot, u_human),
            lambda u_robot, u_human: self._person_reward(now, u_robot, u_human),
            self._starts(now.robot),
            torch.zeros(size, dtype=torch.float64),
            shift=self._dt / STEP_S,
            controls=2,
            followers=len(self._names),
            derivatives=lambda u_robot, u_human: self._person_derivatives(now, u_robot, u_human),
            person=(hardest_braking(now.person.speed, self._options.horizon).repeat(len(self._names)), PERSON_HIGH),
        )
        action = plan.u_robot[:2].numpy().copy()
        self._before, self._time = (now, action), self._time + self._dt
        if len(self._names) == 1:
            return Decision(action)
        return Decision(
            action,
            signals={"belief": dict(self.belief), "belief_entropy": {"entropy": float(self._belief.entropy)}},
        )

    def _log_likelihood(self, person: Car) -> Tensor:
        """log p of what the person has just done, for each type: their speed tells which accelerations it may be."""
        assert self._before is not None
        before, action = self._before
        logs = choices_now(before, self._theta, action, self._options.rationality)
        speeds = torch.clamp(before.person.speed + ACCELERATIONS * self._dt, min=0.0)
        away = (speeds - person.speed).abs()
        same = away <= away.min() + STILL
        return torch.logsumexp(torch.where(same, logs, -torch.inf), dim=1)

    def _person_reward(self, now: Situation, u_robot: Tensor, u_human: Tensor) -> Tensor:
        """Sum over types of R_H; of an obstacle, what makes it keep its speed."""
        if self._options.kind == "obstacle":
            return -(u_human**2).sum(-1)
        u, _, d, e, speed = self._together(now, u_robot, u_human)
        return person_reward(self._scene, self._theta, d, e, speed, u).sum(-1)

    def _person_derivatives(self, now: Situation, u_robot: Tensor, u_human: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same, its slope, and minus its Hessian, a block for each type: with numpy, which is several times as fast
        on arrays of this size, where torch is not needed to go back to u_robot."""
        steps = self._options.horizon
        if self._options.kind == "obstacle":
            one = torch.eye(steps, dtype=torch.float64).expand(*u_human.shape[:-1], 1, -1, -1)
            return self._person_reward(now, u_robot, u_human), -2.0 * u_human, 2.0 * one
        per_control = by_controls(steps)
        if u_robot.requires_grad:
            u, _, d, e, speed = self._together(now, u_robot, u_human)
            way, rate, one = (torch.from_numpy(each) for each in per_control)
            value, g, blocks = person_derivatives(
                torch.exp, (way, rate, one), self._scene, self._theta, (d, e, speed, u)
            )
            return value.sum(-1), g.flatten(-2), blocks
        ahead, e = self._ahead(now, u_robot)
        u = u_human.numpy().reshape(*u_human.shape[:-1], len(self._names), steps)
        way, rate, _ = per_control
        going = now.person.speed * STEP_S * np.arange(1, len(way) + 1)
        seen = ahead - going - u @ way.T, e, now.person.speed + u @ rate.T, u
        found = person_derivatives(np.exp, per_control, self._scene, self._theta.numpy(), seen)
        value, g, blocks = (torch.from_numpy(np.ascontiguousarray(each)) for each in found)
        return value.sum(-1), g.flatten(-2), blocks

    def _ahead(self, now: Situation, u_robot: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """How far ahead of where the person is now the robot will be, and how far beside; the last answer is kept."""
        if self._looked is None or self._looked[0] is not now or not torch.equal(self._looked[1], u_robot):
            path = now.robot_path(u_robot)
            d, e = now.from_person(path[0], path[1], torch.zeros((), dtype=torch.float64))
            self._looked = now, u_robot, (d[..., None, :].numpy(), e[..., None, :].numpy())
        return self._looked[2]

    def _robot_reward(self, now: Situation, u_robot: Tensor, u_human: Tensor) -> Tensor:
        u, path, d, e, speed = self._together(now, u_robot, u_human)
        cars = [(d, e)]
        if now.second is not None:
            way = now.second_path(u, follows=self._options.kind != "obstacle")
            cars.append(seen_from(now.second, path[0][..., None, :], path[1][..., None, :], way))
        b = self._belief.probabilities
        goal = goal_reward(GOALS[self._scene.name], self._scene.cruise, u_robot, path, cars) @ b
        if self._options.kind != "active":
            return goal
        weight = self._options.goal_weight * np.exp(self._time / self._options.patience_s)
        way, _ = now.person_path((b[:, None] * u_human.unflatten(-1, (len(b), -1))).sum(-2))
        return self._information(now, u_robot, path, way, (b[:, None] * speed).sum(-2)) + weight * goal

    def _together(
        self, now: Situation, u_robot: Tensor, u_human: Tensor
    ) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor], Tensor, Tensor, Tensor]:
        """The types' controls, the robot's path, and d, e and the person's speed for each type."""
        u = u_human.unflatten(-1, (len(self._names), -1))
        path = now.robot_path(u_robot)
        way, speed = now.person_path(u)
        d, e = now.from_person(path[0][..., None, :], path[1][..., None, :], way)
        return u, path, d, e, speed

    def _information(
        self, now: Situation, u_robot: Tensor, path: tuple[Tensor, ...], way: Tensor, speed: Tensor
    ) -> Tensor:
        """Sum over the plan's steps of I(b, u_R) [nats], with the person where they are expected."""
        steps = self._options.horizon
        robot = (now.robot.x, now.robot.y, now.robot.yaw, now.robot.speed)
        x, y, yaw, v = (before(values, first)[..., :steps].flatten() for values, first in zip(path, robot, strict=True))
        way, speed = before(way, 0.0)[..., :steps], before(speed, now.person.speed)[..., :steps]
        acceleration, steering = (values.flatten() for values in u_robot.unflatten(-1, (-1, 2)).unbind(-1))
        person, first = (now.person, way.flatten(), speed.flatten()), (acceleration, steering)
        rewards = choice_rewards(self._scene, self._theta, (x, y, yaw, v), person, first)
        likelihood = torch.softmax(self._options.rationality * rewards, dim=-1).transpose(0, 1)
        return information_gain(self._belief.probabilities, likelihood).view(way.shape).sum(-1)

    def _starts(self, robot: Car) -> Tensor:
        """Plans to compare: onto the line at several accelerations, half-way to it, and braking beside it."""
        ways = [(0.0, 0.0), (2.0, 0.0), (-2.0, 0.0), (0.0, robot.y / 2.0), (-4.0, robot.y)]
        return torch.stack([self._steered(robot, acceleration, y) for acceleration, y in ways])

    def _steered(self, robot: Car, acceleration: float, y: float) -> Tensor:
        """A plan that steers onto a line beside the road's, at a constant acceleration but for standing still."""
        controls = []
        for _ in range(self._options.horizon):
            held = max(acceleration, -robot.speed / STEP_S)
            yaw = np.clip((y - robot.y) / (1.5 * robot.speed + 1.0), -0.2, 0.2)  # reached in about 1.5 s
            turn = (yaw - robot.yaw) * 2.7 / (STEP_S * max(robot.speed, 1.0))
            steering = float(np.clip(np.arctan(turn), ACTION_LOW[1], ACTION_HIGH[1]))
            controls += [held, steering]
            robot = robot.moved(held, steering, STEP_S)
        return torch.clamp(torch.tensor(controls, dtype=torch.float64), self._low, self._high)
