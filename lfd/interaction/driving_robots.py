"""Robots that drive among people (chapter 10.6); `lfd.interaction.interactive_robot` has the four kinds.

An obstacle keeps its speed, and so does who follows it.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from lfd.core.protocols import Observation
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
from lfd.interaction.driving_way_out import steering_to, with_a_way_out
from lfd.interaction.interactive_robot import InteractiveRobot, RobotOptions, log_likelihood_of
from lfd.interaction.receding_horizon import Limits
from lfd.interaction.stackelberg import Plan
from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, Car, DrivingScene, seen_cars, seen_second

STILL = 1e-6
"""Differences of speed that count as none [m/s]."""


@dataclass(frozen=True, kw_only=True)
class DriverOptions(RobotOptions):
    """What a robot at the wheel is like; steps of a plan are half a second each."""

    types: ClassVar[Mapping[str, tuple[float, ...]]] = TYPES
    learnable: ClassVar[Collection[str]] = TYPES

    assumed: str = "aggressive"

    @property
    def theta(self) -> Mapping[str, tuple[float, ...]]:
        return {**TYPES, **dict(self.learned)}


class InteractiveDriver(InteractiveRobot[Situation]):
    """The robot at the wheel."""

    _controls = 2

    def __init__(self, scene: DrivingScene, control_hz: int, options: DriverOptions):
        options.check()
        self._scene, self._options = scene, options
        self._low, self._high = (torch.tensor(np.tile(end, options.horizon)) for end in (ACTION_LOW, ACTION_HIGH))
        limits = Limits(
            robot=(self._low, self._high), person=(PERSON_LOW, PERSON_HIGH), gradients=options.gradients,
            difference=options.difference,
        )  # fmt: skip
        names = [options.assumed] if options.kind in ("known", "obstacle") else sorted(TYPES)
        super().__init__(control_hz, options, names, limits)

    def reset(self, rng: np.random.Generator) -> None:
        super().reset(rng)
        self._looked: tuple[Situation, Tensor, tuple[np.ndarray, np.ndarray]] | None = None

    def _look(self, observation: Observation) -> Situation:
        return Situation(self._scene, *seen_cars(observation), seen_second(observation))

    def _plan(self, now: Situation) -> Plan:
        size = self._options.horizon * len(self._names)
        return self.planner.plan(
            lambda u_robot, u_human: self._robot_reward(now, u_robot, u_human),
            lambda u_robot, u_human: self._person_reward(now, u_robot, u_human),
            self._starts(now.robot),
            torch.zeros(size, dtype=torch.float64),
            shift=self._dt / STEP_S,
            controls=self._controls,
            followers=len(self._names),
            derivatives=lambda u_robot, u_human: self._person_derivatives(now, u_robot, u_human),
            person=(hardest_braking(now.person.speed, self._options.horizon).repeat(len(self._names)), PERSON_HIGH),
        )

    def _kept_safe(self, now: Situation, action: np.ndarray) -> np.ndarray:
        others = [now.person] if now.second is None else [now.person, now.second]
        return with_a_way_out(action, now.robot, others, self._scene.robot_y, self._dt)

    def _log_likelihood(self, before: Situation, action: np.ndarray, now: Situation) -> Tensor:
        """The person's speed tells which accelerations it may have been."""
        logs = choices_now(before, self._theta, action, self._options.rationality)
        speeds = torch.clamp(before.person.speed + ACCELERATIONS * self._dt, min=0.0)
        return log_likelihood_of(logs, (speeds - now.person.speed).abs(), STILL)

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

        def information() -> Tensor:
            mean, _ = now.person_path((b[:, None] * u_human.unflatten(-1, (len(b), -1))).sum(-2))
            return self._information(now, u_robot, path, mean, (b[:, None] * speed).sum(-2))

        return self._wanted(goal, information)

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
        return self._gain(rewards, way.shape)

    def _starts(self, robot: Car) -> Tensor:
        """Plans to compare: onto the line at several accelerations, half-way to it, and braking beside it."""
        ways = [(0.0, 0.0), (2.0, 0.0), (-2.0, 0.0), (0.0, robot.y / 2.0), (-4.0, robot.y)]
        return torch.stack([self._steered(robot, acceleration, y) for acceleration, y in ways])

    def _steered(self, robot: Car, acceleration: float, y: float) -> Tensor:
        """A plan that steers onto a line beside the road's, at a constant acceleration but for standing still."""
        controls = []
        for _ in range(self._options.horizon):
            held = max(acceleration, -robot.speed / STEP_S)
            steering = float(steering_to(y, robot.y, robot.yaw, robot.speed, STEP_S))
            controls += [held, steering]
            robot = robot.moved(held, steering, STEP_S)
        return torch.clamp(torch.tensor(controls, dtype=torch.float64), self._low, self._high)
