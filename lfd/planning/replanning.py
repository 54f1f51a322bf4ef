"""A plan for what is left: from where an arm is and moves now, to the goal at the same time as before."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lfd.planning.arm_planner import ArmPlanner, Plan, TouchesSomething

FEWEST = 5
"""Waypoints of the shortest rest of a plan."""


class Rest:
    """The rest of a plan's time: `count` waypoints `dt_s` apart, the first of them now."""

    def __init__(self, planner: ArmPlanner, remaining_s: float):
        """`planner` made the whole plan; its waypoints are as far apart as those of the rest, or farther."""
        self._planner, self.remaining_s = planner, remaining_s
        self.count = max(FEWEST, int(np.ceil(remaining_s / planner.dt_s - 1e-9)) + 1)
        self.dt_s = remaining_s / (self.count - 1)

    def times(self, now_s: float) -> Float[np.ndarray, "N"]:
        """Of the waypoints [s]."""
        return now_s + self.dt_s * np.arange(self.count)

    def features(self, trajectories: Float[np.ndarray, "B N D"]) -> Float[np.ndarray, "B K"]:
        """Feature counts of ways through the rest."""
        return self._planner.features_of(trajectories, self.dt_s)

    def replan(
        self,
        weights: Float[np.ndarray, "K"],
        *,
        position: Float[np.ndarray, "D"],
        velocity: Float[np.ndarray, "D"],
        warm: Float[np.ndarray, "N D"],
    ) -> Plan | None:
        """The best way found from `warm` that begins in `position` [rad] with `velocity` [rad/s].

        None where the arm touches something now, or on every way that was found. Counts and costs of the plan are
        those of the rest.
        """
        arm = self._planner.arm
        position = np.clip(position, arm.low, arm.high)
        before = np.clip(position - self.dt_s * velocity, arm.low, arm.high)  # two waypoints say how fast it moves
        try:
            planner = self._planner.onwards(position, waypoints=self.count + 1, duration_s=self.dt_s * self.count)
        except TouchesSomething:
            return None
        whole = np.concatenate([before[None], warm])
        whole[1] = position
        plan = planner.plan(weights, warm=whole, fixed=2, starts=1)
        if plan.collides:
            return None
        trajectory = plan.trajectory[1:]
        counts = self.features(trajectory[None])[0]
        reward = float(weights @ counts)
        return replace(
            plan, trajectory=trajectory, features=counts, reward=reward, cost=plan.cost + plan.reward - reward
        )
