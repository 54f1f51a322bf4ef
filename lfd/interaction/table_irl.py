"""What people at the table chose from, as inverse RL needs it (`lfd.interaction.choices_irl`)."""

import numpy as np
import torch

from lfd.core.episode import Episode
from lfd.core.errors import InputError
from lfd.interaction.choices_irl import Choices, Person
from lfd.interaction.table_model import reach_now
from lfd.interaction.table_people import VELOCITIES, choice_rewards
from lfd.worlds.shared_table import HAND_HIGH, HAND_LOW, seen_table
from lfd.worlds.shared_table_guard import GOAL_SPEED
from lfd.worlds.shared_table_model import OBJECTS

FEATURES = ("yielding",)
"""Of R_H (`lfd.interaction.table_model`); what the way, effort and a touch count for is known."""
WIDE = (400.0,)
"""Standard deviation of the prior."""
NEAR_M = 1e-6
"""Differences from where a velocity leads to that are rounding [m]."""
UNITS = torch.tensor([[i, weight] for i in range(len(OBJECTS)) for weight in (0.0, 1.0)], dtype=torch.float64)
"""theta of who goes for each cube, without yielding and with 1 of it."""


def choices_of(episode: Episode) -> Person:
    """The choices of the person in a recorded episode, for each cube that they may have gone for.

    Where the hand went tells what they chose. Steps in which several velocities lead there, at the end of their reach,
    are left out. Raises `InputError` for an episode whose person chose otherwise, or nothing.
    """
    tables = [
        seen_table({name: values[t] for name, values in episode.observations.items()}) for t in range(len(episode) + 1)
    ]
    rows, chosen = [], []
    for now, after, action in zip(tables, tables[1:], episode.actions, strict=False):
        ends = np.clip(now.hand + VELOCITIES.numpy() / episode.metadata.control_hz, HAND_LOW, HAND_HIGH)
        (there,) = np.nonzero(np.linalg.norm(ends - after.hand, axis=1) < NEAR_M)
        if not len(there):
            raise InputError(
                "the episode's person did not choose from the velocities that people have here; give recordings of "
                "`lfd interact shared_table`"
            )
        if len(there) > 1:
            continue
        reach, first = reach_now(now), torch.from_numpy(np.clip(action, -GOAL_SPEED, GOAL_SPEED)).double()
        rows.append(choice_rewards(reach, UNITS, reach.gripper[None], reach.hand[None], first[None])[0])
        chosen.append(int(there[0]))
    if not rows:
        raise InputError("the episode's person does not move; give recordings of `lfd interact shared_table`")
    known, with_one = torch.stack(rows).unflatten(1, (-1, 2)).unbind(2)  # (T, cubes, A) each
    features = (known - with_one)[..., None]
    return tuple(Choices(known[:, i].numpy(), features[:, i].numpy(), np.array(chosen)) for i in range(len(OBJECTS)))
