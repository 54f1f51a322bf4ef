"""How a scripted expert goes about its task, so that demonstrations are not all alike."""

from dataclasses import dataclass

import numpy as np

from lfd.core.errors import RecipeError, UnknownName

APPROACHES = {"nearest": "the grasp that is nearest", "any": "each episode one of the grasps that the task allows"}


@dataclass(frozen=True, kw_only=True)
class ExpertStyle:
    """What differs from expert to expert of the same task."""

    speed: tuple[float, ...] = (1.0, 1.0)
    """Lowest and highest speed, as a fraction of the controller's full action; each episode draws its own."""
    approach: str = "nearest"
    """From which side an object is grasped: nearest, or any (each episode draws its own)."""

    def check(self, where: str) -> None:
        if len(self.speed) != 2 or not 0.1 <= self.speed[0] <= self.speed[1] <= 1.0:
            raise RecipeError(
                f"{where} expert_speed = {list(self.speed)}: expected [lowest, highest] within 0.1 to 1.0"
            )
        if self.approach not in APPROACHES:
            raise UnknownName(f"expert_approach in {where}:", self.approach, APPROACHES)

    def draw_speed(self, rng: np.random.Generator) -> float:
        """The speed of an episode."""
        low, high = self.speed
        return float(rng.uniform(low, high))

    def draw_grasp(self, rng: np.random.Generator, grasps: int) -> int | None:
        """Which of an object's grasps to take in an episode; none means the nearest."""
        return int(rng.integers(grasps)) if self.approach == "any" else None


PLAIN = ExpertStyle()
"""Full speed, the nearest grasp."""
