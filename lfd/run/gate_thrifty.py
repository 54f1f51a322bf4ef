"""The thrifty gate: the expert acts where the state is new or the outcome at risk, within a budget (ThriftyDAgger).

Hoque et al. 2021, "ThriftyDAgger: Budget-Aware Novelty and Risk Gating for Interactive Imitation Learning":

    to the expert    novelty(x) > delta_h  or  risk(x, u_R) > beta_h
    to the learner   |u_R - u_H| < delta_r  and  risk(x, u_R) < beta_r

with u_R the learner's and u_H the expert's action, and risk = 1 - Q, where Q(x, u) = E[gamma^k], k the steps until the
task is solved when u is applied and the learner goes on; gamma^k is 0 where it never is.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from lfd.core.errors import InputError
from lfd.run.gate_judge import Judge, JudgeTraining, features, fit_judge
from lfd.run.gates import Moment, Ruling, disagreement, discrepancy, joint_thresholds

REFRESH = 50
"""Gradient steps after which the targets rest on the newest judge."""


@dataclass(frozen=True, kw_only=True)
class Experience:
    """Steps of episodes, by whoever acted in them, to learn risk from."""

    states: Float[np.ndarray, "N Do"]
    actions: Float[np.ndarray, "N Da"]
    """What was applied."""
    next_states: Float[np.ndarray, "N Do"]
    next_actions: Float[np.ndarray, "N Da"]
    """What the present learner would do in the next states."""
    solved: Bool[np.ndarray, "N"]
    """Whether the task was solved after the step."""
    ended: Bool[np.ndarray, "N"]
    """Whether the episode ended with the step; unsolved then means failed."""


def fit_risk(experience: Experience, *, discount: float, how: JudgeTraining) -> Judge:
    """A judge of (state, action): Q, the discounted probability that the task will be solved.

    Temporal differences, with the answers of an older judge Q' on the right:

        Q(x_t, u_t) = 1                               where the step solved the task,
                      0                               where the episode ended without,
                      gamma Q'(x_t+1, pi_hat(x_t+1))  else

    They evaluate the present learner also from steps that others made. Raises `InputError` for a discount beyond (0, 1]
    or when no step solved the task: then everything is equally at risk.
    """
    if not 0.0 < discount <= 1.0:
        raise InputError(f"discount = {discount}: must be above 0 and at most 1")
    if not experience.solved.any():
        raise InputError("no step of the experience solved the task; add demonstrations or successful rollouts to it")
    rows = np.hstack([experience.states, experience.actions])
    following = torch.as_tensor(np.hstack([experience.next_states, experience.next_actions]), dtype=torch.float32)
    solved = torch.as_tensor(experience.solved, dtype=torch.float32)
    goes_on = torch.as_tensor(~(experience.solved | experience.ended), dtype=torch.float32)
    older: list[Judge] = []
    taken = 0

    def targets(judge: Judge, index: torch.Tensor) -> torch.Tensor:
        nonlocal taken
        if taken % REFRESH == 0:
            older[:] = [deepcopy(judge)]
        taken += 1
        return solved[index] + goes_on[index] * discount * torch.sigmoid(older[0](following[index]))

    return fit_judge(rows, how, targets)


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """When the thrifty gate switches."""

    novelty: float
    """delta_h: disagreement of the learners above which the expert takes over [action]."""
    risk: float
    """beta_h: risk above which the expert takes over."""
    agreement: float
    """delta_r: distance from the expert's action below which the learner may have control back [action]."""
    calm: float
    """beta_r: risk below which the learner may have control back."""


def thresholds_for(
    budget: float,
    novelties: Float[np.ndarray, "N"],
    risks: Float[np.ndarray, "N"],
    discrepancies: Float[np.ndarray, "L"],
) -> Thresholds:
    """Thresholds with which the expert takes over in a share `budget` of the states that the learner visited.

    `novelties` and `risks` are those of visited states, `discrepancies` the learner's distances from its L labels. As
    in the paper delta_r is their root mean square and beta_r the median risk. Other than there, the two quantiles are
    found together, so that the budget holds for both reasons in sum, and beta_r is at most beta_h. The budget is of
    states that switch: how long the expert then acts depends on how soon the two agree.
    """
    novelty, risk = joint_thresholds(novelties, risks, budget)
    agreement = float(np.sqrt(np.mean(np.square(discrepancies))))
    return Thresholds(novelty=novelty, risk=risk, agreement=agreement, calm=min(float(np.median(risks)), risk))


class ThriftyGate:
    """Switches to the expert and back, with thresholds far enough apart that control does not go to and fro.

    `judge` answers about the `channels` of an observation followed by the action. While the expert acts its label is
    compared with the learner's action; where they agree, the learner has control from the next step on.
    """

    def __init__(self, judge: Judge, channels: Sequence[str], thresholds: Thresholds):
        self._judge, self._channels, self._thresholds = judge, channels, thresholds
        self._expert_controls: dict[int, bool] = {}

    def reset(self, place: int) -> None:
        self._expert_controls[place] = False

    def rule(self, place: int, moment: Moment) -> Ruling:
        limits = self._thresholds
        novelty, risk = disagreement(moment.proposals), self.risk(moment)
        acts = self._expert_controls[place] or novelty > limits.novelty or risk > limits.risk
        if acts:
            agree = discrepancy(moment.action, moment.ask()) < limits.agreement and risk < limits.calm
            self._expert_controls[place] = not agree
        return Ruling(acts, measured={"novelty": novelty, "risk": risk})

    def risk(self, moment: Moment) -> float:
        """1 - Q of what the learner would do."""
        row = np.append(features(moment.observation, self._channels), moment.action)
        return 1.0 - float(self._judge.of(row[None])[0])
