"""What a person corrects: an arm carries a cup, and does not know one thing that they care for (Bajcsy et al. 2017)."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lfd.core.errors import UnknownName
from lfd.loops.cup_scenes import Placement, draw_placement
from lfd.planning.kinematics import Arm

FEATURES = ("cup_tilt", "table_distance", "laptop_closeness", "person_closeness")
"""What the robot can learn to care for, in every task."""
RANGE_1 = np.array([0.4, 0.3, 0.3, 0.25])
"""By how much a feature's mean over time varies between plausible ways [its unit]."""
USUAL = np.array([-0.5, -0.3, -0.5, -0.8])
"""What people care, in the middle [1/(unit s)]; they differ by a factor of exp(N(0, 0.3))."""
VARIETY = 0.3
AWAY_M = 2.5
"""Where in x or y a person or laptop is that is not in the scene [m]."""


@dataclass(frozen=True)
class CorrectionTask:
    """What is wrong at first."""

    feature: str
    """What the person cares for."""
    told: str
    """What they want, in words."""
    believed: float
    """The robot's weight for it in the beginning [1/(unit s)]."""
    has_laptop: bool = False
    has_person: bool = False

    @property
    def index(self) -> int:
        """Of the feature."""
        return FEATURES.index(self.feature)

    @property
    def start_weights(self) -> Float[np.ndarray, "K"]:
        """The robot's in the beginning."""
        return np.where(np.arange(len(FEATURES)) == self.index, self.believed, 0.0)

    def draw_weights(self, rng: np.random.Generator) -> Float[np.ndarray, "K"]:
        """Those of a person: of the feature alone."""
        usual = USUAL * np.exp(rng.normal(0.0, VARIETY, len(USUAL)))
        return np.where(np.arange(len(FEATURES)) == self.index, usual, 0.0)

    def draw_scene(self, arm: Arm, rng: np.random.Generator) -> Placement:
        """A scene with what the task is about, and nothing else to stay away from."""
        placement = draw_placement(arm, rng)
        x, _, z = placement.laptop_m
        if not self.has_laptop:
            placement = replace(placement, laptop_m=(x, AWAY_M, z))
        if not self.has_person:
            placement = replace(placement, person_m=(AWAY_M, *placement.person_m[1:]))
        return placement


TASKS = {
    "cup": CorrectionTask("cup_tilt", "the cup upright; the robot believes that tilting it is good", 0.12),
    "table": CorrectionTask("table_distance", "the cup low over the table", 0.0),
    "laptop": CorrectionTask("laptop_closeness", "not over the laptop", 0.0, has_laptop=True),
    "person": CorrectionTask("person_closeness", "not so near to the person", 0.0, has_person=True),
}


def load_correction_task(name: str) -> CorrectionTask:
    """The task of a name. Raises `UnknownName` with the names of all."""
    if name not in TASKS:
        raise UnknownName("task of corrections", name, TASKS)
    return TASKS[name]
