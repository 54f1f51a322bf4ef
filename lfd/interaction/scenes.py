"""Scenes in which robots meet people, by name: what makes their world, their people and their robots.

A scene's rows are all that `lfd interact` and exact replay know of it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from jaxtyping import Float

from lfd.core.episode import Episode
from lfd.core.errors import UnknownName
from lfd.core.protocols import Observation, World
from lfd.interaction import driving_irl, driving_model, driving_people, table_irl, table_model, table_people
from lfd.interaction.choices_irl import Person
from lfd.interaction.driving_robots import DriverOptions, InteractiveDriver
from lfd.interaction.interactive_robot import InteractiveRobot, RobotOptions
from lfd.interaction.table_robots import InteractiveReacher, ReacherOptions
from lfd.worlds import shared_table
from lfd.worlds.driving_world import DrivingWorld, least_distance, load_scene, seen_cars
from lfd.worlds.shared_table import SharedTableWorld


@dataclass(frozen=True, kw_only=True)
class InteractionScene:
    """One scene."""

    types: tuple[str, ...]
    """Of people, by what they are after; beliefs are about them."""
    people: tuple[str, ...]
    """Who may be met: one type, a kind of them, or any."""
    assumed: str
    """Type that `known` takes people for where nothing else is said."""
    options: type[RobotOptions]
    """Makes a robot's options from `kind`, `assumed` and others by name."""
    world: Callable[[str, int, float], World]
    """From the people, the control rate [Hz] and their rationality; it may be the same one, to be reset."""
    robot: Callable[..., InteractiveRobot[Any]]
    """From the control rate [Hz] and the options."""
    learnable: tuple[str, ...]
    """Types of people whose weights `lfd irl people` learns."""
    choices: Callable[[Episode], Person]
    """What the person of a recording chose from, for learning."""
    type_of: Callable[[Float[np.ndarray, "D"]], str]
    """The type that a person's theta is nearest to."""
    offset: Callable[[Observation], tuple[float, float]]
    """Where the robot is, from the person: x and y, in the world's axes [m]."""
    distance: Callable[[Observation], float]
    """Between their surfaces [m]."""

    def robots(self, kinds: Sequence[str], assumed: str | None = None, **others: Any) -> tuple[RobotOptions, ...]:
        """Options of some kinds of robots, the others the same for all.

        Raises `UnknownName` for an assumed type that the scene does not have.
        """
        if assumed is not None and assumed not in self.types:
            raise UnknownName("type of person", assumed, self.types)
        return tuple(self.options(kind=kind, assumed=assumed or self.assumed, **others) for kind in kinds)


def _driving(name: str) -> InteractionScene:
    scene = load_scene(name)

    def world(person: str, control_hz: int, rationality: float) -> World:
        return DrivingWorld(scene, driving_people.BoltzmannDriver(scene, person, rationality), control_hz)

    def offset(observation: Observation) -> tuple[float, float]:
        robot, person = seen_cars(observation)[:2]
        return robot.x - person.x, robot.y - person.y

    return InteractionScene(
        types=tuple(sorted(driving_model.TYPES)),
        people=driving_people.PEOPLE,
        assumed="aggressive",
        options=DriverOptions,
        world=world,
        robot=lambda control_hz, options: InteractiveDriver(scene, control_hz, options),
        learnable=tuple(driving_model.TYPES),
        choices=partial(driving_irl.choices_of, scene),
        type_of=driving_people.type_of,
        offset=offset,
        distance=least_distance,
    )


@lru_cache(maxsize=2)
def _table_world(person: str, control_hz: int, rationality: float) -> World:
    """Kept, since robosuite takes seconds to build it."""
    return SharedTableWorld(table_people.BoltzmannHand(person, rationality), control_hz)


def _table_offset(observation: Observation) -> tuple[float, float]:
    x, y = (observation["ee_pos"] - observation["hand_pos"])[:2].tolist()
    return x, y


SCENES: Mapping[str, InteractionScene] = {
    "merge": _driving("merge"),
    "crossing": _driving("crossing"),
    shared_table.TASK: InteractionScene(
        types=tuple(sorted(table_model.TYPES)),
        people=table_people.PEOPLE,
        assumed="middle-insists",
        options=ReacherOptions,
        world=_table_world,
        robot=InteractiveReacher,
        learnable=tuple(table_model.MANNERS),
        choices=table_irl.choices_of,
        type_of=table_people.type_of,
        offset=_table_offset,
        distance=lambda observation: float(observation["hand_distance"][0]),
    ),
}
"""Scenes by name."""


def scene_of(name: str) -> InteractionScene:
    """The scene called `name`. Raises `UnknownName` with the names of all."""
    if name not in SCENES:
        raise UnknownName("scene", name, SCENES)
    return SCENES[name]
