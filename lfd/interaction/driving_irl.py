"""What people at the wheel chose from, as inverse RL needs it (`lfd.interaction.choices_irl`)."""

import numpy as np
import torch

from lfd.core.episode import Episode
from lfd.core.errors import InputError
from lfd.interaction.choices_irl import Choices, Person
from lfd.interaction.driving_people import ACCELERATIONS, choice_rewards
from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, Car, DrivingScene, seen_cars

FEATURES = ("speed", "effort", "giving way", "standing")
"""Of R_H, in theta's order (`lfd.interaction.driving_model`); what a crash counts for is known."""
WIDE = (1.0, 5.0, 400.0, 400.0)
"""Standard deviations of the prior."""
NEAR_M_S = 1e-6
"""Differences of speed from what an acceleration leads to that are rounding [m/s]."""


def choices_of(scene: DrivingScene, episode: Episode) -> Person:
    """The choices of the person in a recorded episode, which leave nothing open.

    What the person did is told by their speed. Steps in which they come to a stop are left out: several accelerations
    lead there. Raises `InputError` for an episode whose person chose otherwise, or nothing.
    """
    rows = [
        seen_cars({name: values[t] for name, values in episode.observations.items()}) for t in range(len(episode) + 1)
    ]
    robots, people = zip(*rows, strict=True)
    speeds = np.array([person.speed for person in people])
    ends = speeds[:-1, None] + ACCELERATIONS.numpy() / episode.metadata.control_hz
    away = np.abs(ends - speeds[1:, None])
    moves = speeds[1:] > 0.0
    if not moves.any() or (away[moves].min(axis=1) > NEAR_M_S).any():
        raise InputError(
            "the episode's person did not choose from the accelerations that people have here; give recordings of "
            "`lfd interact`, in which they move"
        )
    robot = [torch.tensor([getattr(car, name) for car in robots[:-1]]) for name in ("x", "y", "yaw", "speed")]
    first = torch.from_numpy(np.clip(episode.actions, ACTION_LOW, ACTION_HIGH)).unbind(-1)
    start: Car = people[0]
    way = np.hypot(*np.array([[p.x - start.x, p.y - start.y] for p in people[:-1]]).T)
    person = start, torch.from_numpy(way), torch.from_numpy(speeds[:-1])
    units = torch.cat([torch.zeros(1, len(FEATURES)), torch.eye(len(FEATURES))]).double()
    x, y, yaw, speed = (values.double() for values in robot)
    rewards = choice_rewards(scene, units, (x, y, yaw, speed), person, (first[0], first[1])).numpy()
    known, with_one = rewards[:, 0], rewards[:, 1:]
    features = np.moveaxis(known[:, None] - with_one, 1, 2)
    return (Choices(known[moves], features[moves], away[moves].argmin(axis=1)),)
