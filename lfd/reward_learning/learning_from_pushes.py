"""Weights that learn from one push after the other, by one of the rules of `lfd.reward_learning.corrections`.

all         w <- w + B (f(tau_H) - f(tau_R)),  B = diag(beta / range_k^2)      Bajcsy et al. 2017
one         the same for the one feature whose change is the largest part of its range      Bajcsy et al. 2018
confident   `all`, times the share of the push that the gradients of all features explain      after Bobu et al. 2018
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError, UnknownName
from lfd.reward_learning.corrections import correction_update, explained_share, one_feature_update

RULES = ("one", "all", "confident")
LEAST = 0.03
"""Share of its range that some feature must change by, else a push teaches nothing: it may have been a bump."""
SLOPE = 1e-4
"""Step of the difference quotient along a joint [rad]."""
Counts = Callable[[Float[np.ndarray, "B N D"]], Float[np.ndarray, "B K"]]


@dataclass(frozen=True)
class Learned:
    """What one update learned."""

    f_planned: Float[np.ndarray, "K"]
    f_corrected: Float[np.ndarray, "K"]
    share: float
    """How much of the change counts: 1 but for `confident`."""
    before: Float[np.ndarray, "K"]
    after: Float[np.ndarray, "K"]

    @property
    def difference(self) -> Float[np.ndarray, "K"]:
        """f(tau_H) - f(tau_R), as far as it counts, of the features that moved."""
        return np.where(self.after == self.before, 0.0, self.share * (self.f_corrected - self.f_planned))


@dataclass
class PushLearner:
    """Weights, and how they change."""

    features: tuple[str, ...]
    """Names of the K features."""
    weights: Float[np.ndarray, "K"]
    """w now; reward for each unit of a feature count."""
    ranges: Float[np.ndarray, "K"]
    """By how much each feature count varies between trajectories."""
    step: float
    """beta: by how much a change of a whole range moves w range."""
    rule: str = "one"
    lower: Float[np.ndarray, "K"] | float | None = None
    """Bounds of the feasible weights."""
    upper: Float[np.ndarray, "K"] | float | None = None
    history: list[Learned] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise UnknownName("rule", self.rule, RULES)
        if not self.step > 0.0:
            raise InputError(f"step = {self.step}: must be positive, else nothing is learned")

    def learn(
        self,
        planned: Float[np.ndarray, "N D"],
        corrected: Float[np.ndarray, "N D"],
        push: Float[np.ndarray, "D"],
        counts: Counts,
    ) -> Learned:
        """Take a correction in: `corrected` was preferred to `planned`; `counts` are their feature counts.

        `push` is the torque at the joints with which the person said so [N m].
        """
        f_planned, f_corrected = counts(np.stack([planned, corrected]))
        before, share = self.weights, 1.0
        beta = self.step / self.ranges**2
        if self.rule == "one":
            f_corrected = self._feasible(f_corrected, f_planned)
        if np.abs((f_corrected - f_planned) / self.ranges).max() < LEAST:
            f_corrected = f_planned
        if self.rule == "one":
            _, k = one_feature_update(before, f_corrected, f_planned, step_size=1.0, ranges=self.ranges)
            f_corrected = np.where(np.arange(len(before)) == k, f_corrected, f_planned)
        elif self.rule == "confident":
            share = explained_share(push, slopes(planned, corrected, counts))
            beta = beta * max(share, 1e-12)
        self.weights = correction_update(
            before, f_corrected, f_planned, step_size=beta, lower=self.lower, upper=self.upper
        )
        self.history.append(Learned(f_planned, f_corrected, share, before, self.weights))
        return self.history[-1]

    def _feasible(
        self, f_corrected: Float[np.ndarray, "K"], f_planned: Float[np.ndarray, "K"]
    ) -> Float[np.ndarray, "K"]:
        """The counts without the changes that weights at their bounds cannot follow: nobody can have meant those."""
        change = f_corrected - f_planned
        low = -np.inf if self.lower is None else self.lower
        high = np.inf if self.upper is None else self.upper
        blocked = ((change > 0) & (self.weights >= high)) | ((change < 0) & (self.weights <= low))
        return np.where(blocked, f_planned, f_corrected)


def slopes(
    planned: Float[np.ndarray, "N D"], corrected: Float[np.ndarray, "N D"], counts: Counts
) -> Float[np.ndarray, "K D"]:
    """How each count changes when a joint moves in the shape of the correction, for each radian at its largest."""
    size = np.linalg.norm(corrected - planned, axis=1)
    shape = size / size.max() if size.any() else np.ones(len(size))
    nudged = planned + SLOPE * shape[:, None] * np.eye(planned.shape[1])[:, None]
    return ((counts(nudged) - counts(planned[None])) / SLOPE).T
