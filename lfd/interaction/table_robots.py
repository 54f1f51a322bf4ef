"""Robots that share a table (chapter 10.6); `lfd.interaction.interactive_robot` has the four kinds.

theta is one of six, and R_goal depends on it, too. An obstacle keeps its velocity, and claims no cube. The first
velocity of the plan is the action; the world keeps it off the hand.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.protocols import Observation
from lfd.interaction.interactive_robot import InteractiveRobot, RobotOptions, log_likelihood_of
from lfd.interaction.receding_horizon import Limits
from lfd.interaction.stackelberg import Plan
from lfd.interaction.table_model import (
    MANNERS,
    STEP_S,
    TYPES,
    Reach,
    TableGoal,
    goal_reward,
    person_derivatives,
    person_reward,
    reach_now,
)
from lfd.interaction.table_people import VELOCITIES, choice_rewards, choices_now
from lfd.worlds.shared_table import ABOVE_M, HAND_HIGH, HAND_LOW, REST_M, Table, seen_table
from lfd.worlds.shared_table_guard import GOAL_SPEED, HAND_SPEED

STILL_M = 1e-7
"""Differences of where the hand is that count as none [m]."""


@dataclass(frozen=True, kw_only=True)
class ReacherOptions(RobotOptions):
    """What a robot at the table is like; steps of a plan are 0.4 s each."""

    types: ClassVar[Mapping[str, tuple[float, ...]]] = TYPES
    learnable: ClassVar[Collection[str]] = MANNERS

    assumed: str = "middle-insists"
    gradients: int = 3
    patience_s: float = 1.0

    @property
    def theta(self) -> Mapping[str, tuple[float, ...]]:
        yielding = {name: (weight,) for name, weight in MANNERS.items()} | dict(self.learned)
        return {name: (cube, *yielding[name.partition("-")[2]]) for name, (cube, _) in TYPES.items()}


class InteractiveReacher(InteractiveRobot[Table]):
    """The robot at the table."""

    _controls = 3

    def __init__(self, control_hz: int, options: ReacherOptions, goal: TableGoal | None = None):
        options.check()
        self._options, self._goal = options, goal or TableGoal()
        limits = Limits(
            robot=(-GOAL_SPEED, GOAL_SPEED), person=(-HAND_SPEED, HAND_SPEED), gradients=options.gradients,
            difference=options.difference, ridge=1e-6,
        )  # fmt: skip
        only = {"known": options.assumed, "obstacle": "middle-yields"}  # the second claims nothing
        names = (only[options.kind],) if options.kind in only else sorted(TYPES)
        super().__init__(control_hz, options, names, limits)

    def _look(self, observation: Observation) -> Table:
        return seen_table(observation)

    def _plan(self, now: Table) -> Plan:
        reach, keeps = reach_now(now), self._velocity(now)
        return self.planner.plan(
            lambda u_robot, u_human: self._robot_reward(reach, u_robot, u_human),
            lambda u_robot, u_human: self._person_reward(reach, keeps, u_robot, u_human),
            self._starts(reach),
            keeps.repeat_interleave(self._options.horizon).repeat(len(self._names)),
            shift=self._dt / STEP_S,
            controls=self._controls,
            followers=len(self._names),
            derivatives=lambda u_robot, u_human: self._person_derivatives(reach, keeps, u_robot, u_human),
        )

    def _log_likelihood(self, before: Table, action: np.ndarray, now: Table) -> Float[Tensor, "P"]:
        """Where the hand is tells which velocities it may have had."""
        logs = choices_now(before, self._theta, action, self._options.rationality)
        ends = np.clip(before.hand + self._dt * VELOCITIES.numpy(), HAND_LOW, HAND_HIGH)
        return log_likelihood_of(logs, torch.from_numpy(np.linalg.norm(ends - now.hand, axis=1)), STILL_M)

    def _velocity(self, table: Table) -> Float[Tensor, "2"]:
        """Of the hand in the last step [m/s]."""
        if self._before is None:
            return torch.zeros(2, dtype=torch.float64)
        return torch.from_numpy((table.hand - self._before[0].hand) / self._dt)

    def _person_reward(self, now: Reach, keeps: Tensor, u_robot: Tensor, u_human: Tensor) -> Tensor:
        """Sum over types of R_H; of an obstacle, what makes it keep its velocity."""
        u = u_human.unflatten(-1, (len(self._names), 2, -1))
        if self._options.kind == "obstacle":
            return -((u - keeps[:, None]) ** 2).sum((-1, -2, -3))
        path, hand = now.robot_path(u_robot)[..., None, :, :], now.person_path(u)
        return person_reward(self._theta, now.targets(self._theta), path, hand, (u**2).sum(-2)).sum(-1)

    def _person_derivatives(
        self, now: Reach, keeps: Tensor, u_robot: Tensor, u_human: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same, its slope, and minus its Hessian, a block for each type."""
        u = u_human.unflatten(-1, (len(self._names), 2, -1))
        if self._options.kind == "obstacle":
            once = 2.0 * torch.eye(u_human.shape[-1], dtype=torch.float64)
            slope = -2.0 * (u - keeps[:, None]).flatten(-3)
            return -0.25 * (slope**2).sum(-1), slope, once.expand(*u_human.shape[:-1], 1, -1, -1)
        path, hand = now.robot_path(u_robot)[..., None, :, :], now.person_path(u)
        value, g, blocks = person_derivatives(self._theta, now.targets(self._theta), path, hand, u)
        return value.sum(-1), g.flatten(-2), blocks

    def _robot_reward(self, now: Reach, u_robot: Tensor, u_human: Tensor) -> Tensor:
        path, b = now.robot_path(u_robot), self._belief.probabilities
        hand = now.person_path(u_human.unflatten(-1, (len(self._names), 2, -1)))
        goal = goal_reward(self._goal, now, self._theta, u_robot, path, hand) @ b
        return self._wanted(goal, lambda: self._information(now, u_robot, path, (b[:, None, None] * hand).sum(-3)))

    def _information(self, now: Reach, u_robot: Tensor, path: Tensor, hand: Tensor) -> Tensor:
        """Sum over the plan's steps of I(b, u_R) [nats], with the person where they are expected."""
        first = now.gripper.expand_as(path[..., :1, :]), now.hand.expand_as(hand[..., :1, :])
        gripper, there = (
            torch.cat([begin, way[..., :-1, :]], dim=-2) for begin, way in zip(first, (path, hand), strict=True)
        )
        velocity = u_robot.unflatten(-1, (-1, 3))
        rewards = choice_rewards(
            now, self._theta, gripper.reshape(-1, 3), there.reshape(-1, 2), velocity.reshape(-1, 3)
        )
        return self._gain(rewards, path.shape[:-1])

    def _starts(self, now: Reach) -> Float[Tensor, "S n"]:
        """Plans to compare: to each cube that is left, back, and nowhere."""
        steps = self._options.horizon
        above = torch.full((len(now.cubes), 1), REST_M + ABOVE_M, dtype=torch.float64)
        left = [i for i in range(len(now.cubes)) if i != now.taken]
        ends = [*torch.cat([now.cubes, above], dim=-1)[left]]
        ends.append(now.gripper + torch.tensor([-0.2, 0.0, 0.1], dtype=torch.float64))
        plans = [torch.zeros(3 * steps, dtype=torch.float64)]
        for end in ends:
            way, controls = end - now.gripper, []
            for _ in range(steps):
                far = float(way.norm())
                velocity = way / max(far, 1e-9) * min(far / STEP_S, GOAL_SPEED)
                controls.append(velocity)
                way = way - STEP_S * velocity
            plans.append(torch.cat(controls))
        return torch.clamp(torch.stack(plans), -GOAL_SPEED, GOAL_SPEED)
