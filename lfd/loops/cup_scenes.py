"""Cup scenes that differ: where the cup starts and ends, where person and laptop are."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError
from lfd.planning.arm_planner import MARGIN_M
from lfd.planning.kinematics import GRIPPER, SPHERES, Arm, forward
from lfd.planning.scenes import (
    CUP_GOAL_M,
    CUP_START_M,
    LAPTOP_HALF_M,
    LAPTOP_M,
    NEAR_LAPTOP_M,
    NEAR_PERSON_M,
    PERSON_M,
    PERSON_RADIUS_M,
    TABLE_HEIGHT_M,
    Scene,
    reach,
)
from lfd.planning.signed_distances import Box, Capsule, Floor, clearance, table_of
from lfd.rewards.arm_features import Places, Spot

SPREAD_M = {
    "cup_start_m": (0.06, 0.06, 0.05),
    "cup_goal_m": (0.06, 0.06, 0.05),
    "person_m": (0.08, 0.20, 0.05),
    "laptop_m": (0.06, 0.12, 0.0),
}
"""By how much each place may differ from `cup_scene`'s, to both sides [m]; uniform."""
PEDESTAL_M, PEDESTAL_HALF_M = (-0.58, 0.0, 0.471), (0.18, 0.18, 0.471)
"""A box around robosuite's pedestal for arms (a cylinder): a hand that is drawn far back would hit it."""
DRAWS = 100
"""After so many scenes in a row that the arm cannot be in, drawing gives up."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """A cup scene for one arm as plain numbers, the way recordings keep it: places [m], postures [rad]."""

    cup_start_m: tuple[float, ...]
    cup_goal_m: tuple[float, ...]
    person_m: tuple[float, ...]
    laptop_m: tuple[float, ...]
    start_rad: tuple[float, ...]
    goal_rad: tuple[float, ...]

    def table(self) -> dict[str, list[float]]:
        """As a recipe's table."""
        return {key: list(value) for key, value in asdict(self).items()}

    @classmethod
    def of(cls, table: Mapping[str, Any], where: str) -> "Placement":
        """The placement of a recipe's table. Raises `InputError` when a key is missing or no row of numbers."""
        keys = tuple(cls.__dataclass_fields__)
        missing = [key for key in keys if key not in table]
        if missing:
            raise InputError(f"{where} lacks {', '.join(missing)}; record it again with `lfd plan`")
        return cls(**{key: tuple(float(x) for x in table[key]) for key in keys})

    def scene(self, arm: Arm) -> Scene:
        """The scene, as `cup_scene` builds it from other numbers, and the robot's pedestal."""
        x, y, z = self.person_m
        laptop = self.laptop_m[0], self.laptop_m[1], self.laptop_m[2]
        goal = np.array(self.goal_rad)
        return Scene(
            name="cup",
            places=Places(
                table_height=TABLE_HEIGHT_M,
                person=Spot(np.array(self.person_m), NEAR_PERSON_M),
                laptop=Spot(np.array(laptop), NEAR_LAPTOP_M),
                goal=forward(arm, goal[None]).points[0, GRIPPER],
            ),
            shapes=(
                Floor(TABLE_HEIGHT_M),
                Box(laptop, LAPTOP_HALF_M),
                Capsule((x, y, 0.0), (x, y, z), PERSON_RADIUS_M),
                Box(PEDESTAL_M, PEDESTAL_HALF_M),
            ),
            start=np.array(self.start_rad),
            goal=goal,
        )


def draw_placement(arm: Arm, rng: np.random.Generator) -> Placement:
    """A scene in which the arm reaches start and goal and stands clear there, by the margin of the planner.

    Others are drawn again. Raises `InputError` when a hundred in a row would not do: the arm is of another size.
    """
    middle = {"cup_start_m": CUP_START_M, "cup_goal_m": CUP_GOAL_M, "person_m": PERSON_M, "laptop_m": LAPTOP_M}
    reason = ""
    for _ in range(DRAWS):
        drawn = {key: np.array(middle[key]) + rng.uniform(-1, 1, 3) * SPREAD_M[key] for key in middle}
        try:
            start = reach(arm, drawn["cup_start_m"], arm.home)
            goal = reach(arm, drawn["cup_goal_m"], start)
        except InputError as error:
            reason = str(error)
            continue
        plain: dict[str, Any] = {key: tuple(map(float, value)) for key, value in drawn.items()}
        found = Placement(**plain, start_rad=tuple(map(float, start)), goal_rad=tuple(map(float, goal)))
        if _clearance(arm, found.scene(arm), np.stack([start, goal])) >= MARGIN_M:
            return found
        reason = "the arm touches something at the start or the goal"
    raise InputError(f"no cup scene of {DRAWS} suits the arm of {arm.robot!r}; the last: {reason}")


def _clearance(arm: Arm, scene: Scene, postures: Float[np.ndarray, "N D"]) -> float:
    """Smallest distance between the arm and the scene's shapes in some postures [m]."""
    points = forward(arm, postures).points[:, SPHERES:]
    return float(clearance(points, arm.radius[SPHERES:], table_of(scene.shapes)).min())
