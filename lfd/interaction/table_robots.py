"""Robots that share a table: one planner, with what it takes people for as an option (chapter 10.6).

    obstacle   the hand keeps its velocity, whatever the robot does
    known      the person has one theta, given: u_H* = argmax R_H(u_R, u_H, theta)
    passive    theta is one of six: argmax sum_theta b(theta) R_goal(u_R, u_H*(theta), theta), b updated by what is seen
    active     the same, with information: argmax I(b, u_R) + lambda(t) sum_theta b(theta) R_goal

As on the road (`lfd.interaction.driving_robots`): people of several types are one follower with a block for each type,
I is the sum of what is expected of the person's next choice at each step of the plan, and lambda(t) = lambda_0 exp(t /
tau). The first velocity of the plan is the action; the world keeps it off the hand. An obstacle claims no cube.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Decision, Observation
from lfd.interaction.information import information_gain
from lfd.interaction.intent import IntentBelief
from lfd.interaction.receding_horizon import Limits, RecedingHorizon
from lfd.interaction.table_model import (
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

KINDS = ("obstacle", "known", "passive", "active")
STILL_M = 1e-7
"""Differences of where the hand is that count as none [m]."""


@dataclass(frozen=True, kw_only=True)
class ReacherOptions:
    """What a robot at the table is like."""

    kind: str
    """obstacle, known, passive or active."""
    assumed: str = "middle-insists"
    """The type that a `known` person is taken for."""
    horizon: int = 5
    """Steps of the plan, of 0.4 s each."""
    gradients: int = 3
    """Gradients for each plan."""
    difference: float = 0.0
    """Step of finite differences in the implicit gradient's place; 0 for the implicit one."""
    rationality: float = 0.3
    """Of the people, as the robot believes."""
    goal_weight: float = 0.05
    """lambda_0 of the active robot."""
    patience_s: float = 1.0
    """tau of the active robot [s]."""

    def check(self) -> None:
        """Raise `UnknownName` for another kind or type, `InputError` for numbers out of range."""
        if self.kind not in KINDS:
            raise UnknownName("robot kind", self.kind, KINDS)
        if self.assumed not in TYPES:
            raise UnknownName("type of person", self.assumed, TYPES)
        for name in ("horizon", "rationality", "goal_weight", "patience_s"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} = {getattr(self, name)}: give a number above 0")


class InteractiveReacher:
    """The robot; its decisions carry the belief as signals, where it has one."""

    def __init__(self, control_hz: int, options: ReacherOptions, goal: TableGoal | None = None):
        options.check()
        self.name, self._dt, self._options = options.kind, 1.0 / control_hz, options
        self._goal = goal or TableGoal()
        only = {"known": options.assumed, "obstacle": "middle-yields"}  # the second claims nothing
        self._names = (only[options.kind],) if options.kind in only else tuple(sorted(TYPES))
        self._theta = torch.tensor([TYPES[name] for name in self._names], dtype=torch.float64)
        self.planner = RecedingHorizon(
            Limits(
                robot=(-GOAL_SPEED, GOAL_SPEED), person=(-HAND_SPEED, HAND_SPEED), gradients=options.gradients,
                difference=options.difference, ridge=1e-6,
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
        self._before: tuple[Table, np.ndarray] | None = None
        self._time = 0.0

    def act(self, observation: Observation) -> Decision:
        table = seen_table(observation)
        if self._before is not None and len(self._names) > 1:
            self._belief = self._belief.updated(self._log_likelihood(table.hand))
        now, keeps = reach_now(table), self._velocity(table)
        plan = self.planner.plan(
            lambda u_robot, u_human: self._robot_reward(now, u_robot, u_human),
            lambda u_robot, u_human: self._person_reward(now, keeps, u_robot, u_human),
            self._starts(now),
            keeps.repeat_interleave(self._options.horizon).repeat(len(self._names)),
            shift=self._dt / STEP_S,
            controls=3,
            followers=len(self._names),
            derivatives=lambda u_robot, u_human: self._person_derivatives(now, keeps, u_robot, u_human),
        )
        action = plan.u_robot[:3].numpy().copy()
        self._before, self._time = (table, action), self._time + self._dt
        if len(self._names) == 1:
            return Decision(action)
        return Decision(
            action,
            signals={"belief": dict(self.belief), "belief_entropy": {"entropy": float(self._belief.entropy)}},
        )

    def _log_likelihood(self, hand: Float[np.ndarray, "2"]) -> Float[Tensor, "P"]:
        """log p of what the person has just done, for each type: where the hand is tells which velocities it may be."""
        assert self._before is not None
        table, action = self._before
        logs = choices_now(table, self._theta, action, self._options.rationality)
        ends = np.clip(table.hand + self._dt * VELOCITIES.numpy(), HAND_LOW, HAND_HIGH)
        away = torch.from_numpy(np.linalg.norm(ends - hand, axis=1))
        return torch.logsumexp(torch.where(away <= away.min() + STILL_M, logs, -torch.inf), dim=1)

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
        if self._options.kind != "active":
            return goal
        weight = self._options.goal_weight * np.exp(self._time / self._options.patience_s)
        return self._information(now, u_robot, path, (b[:, None, None] * hand).sum(-3)) + weight * goal

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
        likelihood = torch.softmax(self._options.rationality * rewards, dim=-1).transpose(0, 1)
        return information_gain(self._belief.probabilities, likelihood).view(path.shape[:-1]).sum(-1)

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
