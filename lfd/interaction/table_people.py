"""People at the table: a Boltzmann choice among velocities of the hand, by what each would lead to (chapter 10.6.2).

    p(u | x, u_R, theta) ~ exp(rationality R_H(theta)),    u in VELOCITIES, held for `LOOK_AHEAD` steps of the plan

They see what the robot does now, not what it plans: for R_H it does so for a step of the plan, then stands still.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.errors import InputError, UnknownName
from lfd.interaction.table_model import MANNERS, STEP_S, TYPES, Reach, limited, person_reward, reach_now
from lfd.worlds.shared_table import HAND_HIGH, HAND_LOW, Table
from lfd.worlds.shared_table_guard import HAND_SPEED

DIRECTIONS = 12
LOOK_AHEAD = 3
SPREAD = 0.2
"""Standard deviation of the logarithm of a person's yielding about its type's."""
PEOPLE = (*sorted(TYPES), *sorted(MANNERS), "random")
"""Of one type, of one manner, or any."""


def _velocities() -> Float[Tensor, "A 2"]:
    """None, and twelve directions at half and at full speed."""
    angles = 2.0 * np.pi * torch.arange(DIRECTIONS, dtype=torch.float64) / DIRECTIONS
    ways = torch.stack([torch.cos(angles), torch.sin(angles)], dim=-1)
    return torch.cat([torch.zeros(1, 2, dtype=torch.float64), 0.5 * HAND_SPEED * ways, HAND_SPEED * ways])


VELOCITIES = _velocities()
"""What people choose from [m/s]."""


def choice_rewards(
    now: Reach, theta: Float[Tensor, "P 2"], gripper: Float[Tensor, "K 3"], hand: Float[Tensor, "K 2"],
    first: Float[Tensor, "K 3"],
) -> Float[Tensor, "K P A"]:  # fmt: skip
    """R_H of each velocity, in K situations at a time: where gripper and hand are, and the gripper's velocity."""
    times = STEP_S * torch.arange(1, LOOK_AHEAD + 1, dtype=torch.float64)
    then = (gripper + STEP_S * limited(first))[:, None, None, None, :].expand(-1, 1, 1, LOOK_AHEAD, 3)
    low, high = (torch.from_numpy(end) for end in (HAND_LOW, HAND_HIGH))
    ways = torch.clamp(hand[:, None, None, :] + VELOCITIES[:, None] * times[:, None], low, high)  # (K, A, L, 2)
    speed = (VELOCITIES**2).sum(-1)[:, None].expand(-1, LOOK_AHEAD)
    rewards = person_reward(
        theta, now.targets(theta), then, ways[:, :, None].expand(-1, -1, len(theta), -1, -1), speed[:, None]
    )
    return rewards.transpose(1, 2)


def choices_now(
    table: Table, theta: Float[Tensor, "P 2"], action: Float[np.ndarray, "3"], rationality: float
) -> Float[Tensor, "P A"]:
    """log p(u | x, u_R, theta) for what the robot does now."""
    now = reach_now(table)
    first = torch.from_numpy(np.array(action, dtype=float))
    rewards = choice_rewards(now, theta, now.gripper[None], now.hand[None], first[None])
    return torch.log_softmax(rationality * rewards[0], dim=-1)


class BoltzmannHand:
    """A person of some type, of some manner or of any, whose yielding differs a little from the type's.

    With infinite rationality they do what is best.
    """

    def __init__(self, kind: str, rationality: float):
        """Raises `UnknownName` for another kind of person, `InputError` for a rationality that is not positive."""
        if kind not in PEOPLE:
            raise UnknownName("person", kind, PEOPLE)
        if not rationality > 0.0:
            raise InputError(f"rationality = {rationality}: give a number above 0, inf for what is best")
        self._kind, self._rationality = kind, rationality

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, "2"]:
        """Theta of a new person."""
        names = [name for name in sorted(TYPES) if self._kind in ("random", name, name.partition("-")[2])]
        cube, yielding = TYPES[names[int(rng.integers(len(names)))]]
        return np.array([cube, yielding * np.exp(SPREAD * rng.normal())])

    def answer(
        self, theta: Float[np.ndarray, "2"], table: Table, action: Float[np.ndarray, "3"], draw: float
    ) -> Float[np.ndarray, "2"]:
        """The hand's velocity [m/s]."""
        best_only = np.isinf(self._rationality)
        logs = choices_now(table, torch.from_numpy(theta)[None], action, 1.0 if best_only else self._rationality)[0]
        chosen = int(logs.argmax()) if best_only else int(torch.searchsorted(logs.exp().cumsum(0), draw))
        return VELOCITIES[min(chosen, len(VELOCITIES) - 1)].numpy().copy()


def type_of(theta: Float[np.ndarray, "2"]) -> str:
    """The type of a person's theta."""
    cube, yielding = float(theta[0]), float(theta[1])
    manner = min(MANNERS, key=lambda name: abs(MANNERS[name] - yielding))
    return next(name for name, (i, weight) in TYPES.items() if (i, weight) == (cube, MANNERS[manner]))
