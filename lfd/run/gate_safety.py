"""The safety gate: a classifier of the state tells where the learner would stray from the expert (SafeDAgger).

Zhang, Cho 2017, "Query-Efficient Imitation Learning for End-to-End Autonomous Driving":

    pi_safe(x) = 1 where |pi_hat(x) - pi*(x)| <= tau, else 0

is learned from labelled states; then it stands in for the expert, who acts (and is asked) only where it says 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.run.gate_judge import Judge, JudgeTraining, features, fit_judge
from lfd.run.gates import Moment, Ruling


def fit_safety(
    states: Float[np.ndarray, "N Do"],
    proposals: Float[np.ndarray, "N Da"],
    labels: Float[np.ndarray, "N Da"],
    *,
    tau: float,
    how: JudgeTraining,
) -> Judge:
    """A judge of states: the probability that the learner is further than `tau` from the expert.

    States that the learner was trained on look safer than others are: keep some back for this. Raises `InputError` for
    states that are all safe or all unsafe, from which nothing can be told.
    """
    unsafe = np.linalg.norm(proposals - labels, axis=1) > tau
    if unsafe.all() or not unsafe.any():
        which = "unsafe" if unsafe.all() else "safe"
        raise InputError(
            f"all {len(states)} states are {which} with tau = {tau}; distances from the expert lie around "
            f"{np.median(np.linalg.norm(proposals - labels, axis=1)):.3g}, choose a tau among them"
        )
    truth = torch.as_tensor(unsafe, dtype=torch.float32)
    return fit_judge(states, how, lambda _, index: truth[index])


@dataclass(frozen=True, kw_only=True)
class SafeGate:
    """The expert acts where the learner is likelier than `threshold` to stray.

    A threshold of 1/2 is SafeDAgger's; `lfd.run.gates.budget_threshold` of the judge's answers in calibration states
    sets the share of the steps instead.
    """

    judge: Judge
    channels: Sequence[str]
    """What the judge sees of an observation, in the order that it was trained with."""
    threshold: float

    def reset(self, place: int) -> None:
        """It has no memory."""

    def rule(self, place: int, moment: Moment) -> Ruling:
        unsafe = float(self.judge.of(features(moment.observation, self.channels)[None])[0])
        return Ruling(unsafe > self.threshold, measured={"unsafe": unsafe})
