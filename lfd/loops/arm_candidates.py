"""Trajectories to choose between in one scene: what inverse RL compares demonstrations with.

They go from the scene's start to its goal and keep clear of things: the straight way, smooth random deviations of all
sizes from it and from the demonstrations, and every plan that was made on the way. Counts have a last column for the
planner's prior, whose weight lambda is known: -1/2 integral |qdd|^2 dt. Learned weights have a scale only against it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lfd.planning.arm_planner import MARGIN_M, ArmPlanner
from lfd.planning.trajectory_costs import rest_to_rest

SMALLEST, LARGEST = 0.02, 1.0
"""Sizes of random deviations, as shares of the planner's own random starts; uniform in the logarithm."""


class Candidates:
    """Candidates of one scene; they grow with every plan."""

    def __init__(
        self, planner: ArmPlanner, demonstrations: Float[np.ndarray, "N T D"], *, count: int, rng: np.random.Generator
    ):
        """Draws `count` deviations from each of the straight way and the demonstrations.

        Left out are those that touch something or come nearer to it than the demonstrations: a planner pays for
        coming near, which no weight of a feature tells. The demonstrations are candidates 0 to N - 1.
        """
        self._planner, self._energy = planner, rest_to_rest(planner.waypoints, planner.dt_s)
        straight = planner.straight()
        drawn = [straight[None]]
        for middle in (straight, *demonstrations):
            away = planner.random_starts(count, rng) - straight
            size = np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST), (count, 1, 1)))
            drawn.append(np.clip(middle + size * away, planner.arm.low, planner.arm.high))
        others = np.concatenate(drawn)
        self.demonstrated = len(demonstrations)
        """How many of the candidates are demonstrations."""
        least = max(0.0, min(MARGIN_M, float(planner.clearance(demonstrations).min())))
        self.trajectories = np.concatenate([demonstrations, others[planner.clearance(others) >= least]])
        self.counts = self.counted(self.trajectories)

    def counted(self, trajectories: Float[np.ndarray, "B T D"]) -> Float[np.ndarray, "B K1"]:
        """Feature counts, and the prior's."""
        energy = 0.5 * np.einsum("btd,ts,bsd->b", trajectories, self._energy, trajectories)
        return np.column_stack([self._planner.features(trajectories), -energy])

    @property
    def expert(self) -> Float[np.ndarray, "K1"]:
        """Mean counts of the demonstrations."""
        return self.counts[: self.demonstrated].mean(axis=0)

    @property
    def straight(self) -> Float[np.ndarray, "K1"]:
        """Counts of the straight way."""
        return self.counted(self._planner.straight()[None])[0]

    def plan(
        self, weights: Float[np.ndarray, "K"], smoothness: float, *, starts: int, rng: np.random.Generator | None
    ) -> int:
        """The candidate that is best for some weights, after a plan from the best so far has joined them.

        `starts` beyond 1 are random. A plan that touches something does not join.
        """
        all_weights = np.append(weights, smoothness)
        warm = self.trajectories[int(np.argmax(self.counts @ all_weights))]
        plan = self._planner.plan(weights, warm=warm, starts=starts, rng=rng)
        if not plan.collides:
            self.trajectories = np.concatenate([self.trajectories, plan.trajectory[None]])
            self.counts = np.concatenate([self.counts, self.counted(plan.trajectory[None])])
        return int(np.argmax(self.counts @ all_weights))

    def differences(self) -> Float[np.ndarray, "M"]:
        """How unlike the demonstrations each candidate is: mean square distance of the joints, of the nearest [rad^2].

        Square, because a reward, too, falls with the square of the distance from its optimum.
        """
        shown = self.trajectories[: self.demonstrated]
        return np.min([((self.trajectories - one) ** 2).sum(axis=2).mean(axis=1) for one in shown], axis=0)


def ranges_of(scenes: Sequence[Candidates]) -> Float[np.ndarray, "K1"]:
    """By how much counts vary between the candidates of a scene: largest less smallest, the mean over scenes."""
    return np.mean([np.ptp(scene.counts, axis=0) for scene in scenes], axis=0)
