"""What robots among people have in common: one planner, with what it takes people for as an option (chapter 10.6).

    obstacle   the person goes on as before, whatever the robot does
    known      they have one theta, given: u_H* = argmax R_H(u_R, u_H, theta)
    passive    theta is one of some types: argmax sum_theta b(theta) R_goal(u_R, u_H*(theta)), b updated by what is seen
    active     the same, with information: argmax I(b, u_R) + lambda(t) sum_theta b(theta) R_goal

The person of several types is one follower, whose controls are those of all types one after the other: their rewards
add up, and the expectation over theta is the robot's reward of the whole. I is the sum of what is expected of the
person's next choice at each step of the plan, at least the information of all of them together, since choices are
independent given theta. lambda(t) = lambda_0 exp(t / tau): first ask, then go.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from lfd.core.errors import InputError, UnknownName
from lfd.core.protocols import Decision, Observation
from lfd.interaction.information import information_gain
from lfd.interaction.intent import IntentBelief
from lfd.interaction.receding_horizon import Limits, RecedingHorizon
from lfd.interaction.stackelberg import Plan

KINDS = ("obstacle", "known", "passive", "active")


@dataclass(frozen=True, kw_only=True)
class RobotOptions(ABC):
    """What a robot of some scene is like."""

    types: ClassVar[Mapping[str, tuple[float, ...]]]
    """Theta of each type of the scene's people."""
    learnable: ClassVar[Collection[str]]
    """Types whose weights may be learned."""

    kind: str
    """obstacle, known, passive or active."""
    assumed: str
    """The type that a `known` person is taken for."""
    horizon: int = 5
    """Steps of the plan."""
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
    """Types with the weights that were learned for them (`lfd.interaction.person_reward`), in place of known ones."""

    @property
    @abstractmethod
    def theta(self) -> Mapping[str, tuple[float, ...]]:
        """Of each type, as the robot believes."""

    def check(self) -> None:
        """Raise `UnknownName` for another kind or type, `InputError` for numbers out of range."""
        if self.kind not in KINDS:
            raise UnknownName("robot kind", self.kind, KINDS)
        if self.assumed not in self.types:
            raise UnknownName("type of person", self.assumed, self.types)
        for name in dict(self.learned):
            if name not in self.learnable:
                raise UnknownName("type of person", name, self.learnable)
        for name in ("horizon", "rationality", "goal_weight", "patience_s"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} = {getattr(self, name)}: give a number above 0")


class InteractiveRobot[Seen](ABC):
    """A policy; its decisions carry the belief as signals, where it has one. A scene says what is seen and planned."""

    def __init__(self, control_hz: int, options: RobotOptions, names: Sequence[str], limits: Limits):
        """`names` are the types that the person may be of."""
        self.name, self._dt, self._names = options.kind, 1.0 / control_hz, tuple(names)
        self._theta = torch.tensor([options.theta[name] for name in names], dtype=torch.float64)
        self.planner = RecedingHorizon(limits)
        self._common = options

    @property
    def belief(self) -> Mapping[str, float]:
        """Probability of each type."""
        return MappingProxyType(dict(zip(self._names, self._belief.probabilities.tolist(), strict=True)))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode; nothing is drawn."""
        del rng
        self.planner.forget()
        self._belief = IntentBelief(self._names, torch.ones(len(self._names)))
        self._before: tuple[Seen, np.ndarray] | None = None
        self._time = 0.0

    def act(self, observation: Observation) -> Decision:
        now = self._look(observation)
        if self._before is not None and len(self._names) > 1:
            before, action = self._before
            self._belief = self._belief.updated(self._log_likelihood(before, action, now))
        action = self._kept_safe(now, self._plan(now).u_robot[: self._controls].numpy().copy())
        self._before, self._time = (now, action), self._time + self._dt
        if len(self._names) == 1:
            return Decision(action)
        return Decision(
            action,
            signals={"belief": dict(self.belief), "belief_entropy": {"entropy": float(self._belief.entropy)}},
        )

    _controls: ClassVar[int]
    """Numbers of an action."""

    @abstractmethod
    def _look(self, observation: Observation) -> Seen:
        """What the robot makes of an observation."""

    @abstractmethod
    def _log_likelihood(self, before: Seen, action: np.ndarray, now: Seen) -> Tensor:
        """log p of what the person has just done, for each type (P,)."""

    @abstractmethod
    def _plan(self, now: Seen) -> Plan: ...

    def _kept_safe(self, now: Seen, action: np.ndarray) -> np.ndarray:
        """What is done in an action's place where it might leave no way out; where the world sees to it, nothing."""
        del now
        return action

    def _wanted(self, goal: Tensor, information: Callable[[], Tensor]) -> Tensor:
        """R_goal, its expectation taken; of the active robot I + lambda(t) R_goal."""
        if self.name != "active":
            return goal
        return information() + self._common.goal_weight * np.exp(self._time / self._common.patience_s) * goal

    def _gain(self, rewards: Tensor, shape: Sequence[int]) -> Tensor:
        """Sum over the plan's steps of I(b, u_R) [nats], from R_H of each choice at all steps (P, steps, choices)."""
        likelihood = torch.softmax(self._common.rationality * rewards, dim=-1).transpose(0, 1)
        return information_gain(self._belief.probabilities, likelihood).view(*shape).sum(-1)


def log_likelihood_of(logs: Tensor, away: Tensor, still: float) -> Tensor:
    """log p of what was done (P,), from log p of each choice (P, A) and how far it would have led from there (A,).

    Several choices may lead to the same place, such as a standstill; differences up to `still` count as none.
    """
    return torch.logsumexp(torch.where(away <= away.min() + still, logs, -torch.inf), dim=1)
