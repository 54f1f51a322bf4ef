"""People at the wheel: a Boltzmann choice among accelerations, by what each would lead to (chapter 10.6.2).

    p(a | x, u_R, theta) ~ exp(rationality R_H(theta)),    a in ACCELERATIONS, held for `LOOK_AHEAD` steps

They see what the robot does now, not what it plans: for R_H it does so for a step of the plan, then goes straight on.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfd.core.errors import InputError, UnknownName
from lfd.interaction.driving_model import PERSON_HIGH, PERSON_LOW, STEP_S, TYPES, Situation, person_reward
from lfd.worlds.driving_world import WHEELBASE, Car, DrivingScene

ACCELERATIONS = torch.linspace(PERSON_LOW, PERSON_HIGH, 14, dtype=torch.float64)
"""What people choose from [m/s^2]."""
LOOK_AHEAD = {"merge": 4, "crossing": 8}
"""Steps of the plan that people look ahead, by scene: over a crossing, which is seen from afar, as far as plans do."""
SPREAD = 0.2
"""Standard deviation of the logarithm of a person's weights about their type's."""
PEOPLE = (*sorted(TYPES), "random")


def choice_rewards(
    scene: DrivingScene,
    theta: Float[Tensor, "P 4"],
    robot: tuple[Tensor, Tensor, Tensor, Tensor],
    person: tuple[Car, Tensor, Tensor],
    first: tuple[Tensor, Tensor],
) -> Float[Tensor, "K P A"]:
    """R_H of each acceleration, in K situations at a time.

    `robot` has x, y, yaw and speed, `person` where they were and, in each situation, the way since and the speed;
    `first` has the robot's acceleration and steering; all of them (K,).
    """
    start, way, speed = person
    x, y, yaw, v = robot
    acceleration, steering = first
    ahead = LOOK_AHEAD[scene.name]
    steps = torch.arange(1, ahead + 1, dtype=torch.float64) * STEP_S
    later = Situation(scene, Car(0.0, 0.0, 0.0, 0.0), start)
    v1 = v + STEP_S * acceleration
    yaw1 = yaw + STEP_S * v * torch.tan(steering) / WHEELBASE
    rest = (steps - STEP_S) * v1[:, None]
    xs = x[:, None] + STEP_S * (v * torch.cos(yaw))[:, None] + rest * torch.cos(yaw1)[:, None]
    ys = y[:, None] + STEP_S * (v * torch.sin(yaw))[:, None] + rest * torch.sin(yaw1)[:, None]
    a = ACCELERATIONS[:, None]
    speeds = torch.clamp(speed[:, None, None] + a * steps, min=0.0)  # (K, A, N)
    before = torch.cat([speed[:, None, None].expand(-1, len(a), 1), speeds[..., :-1]], dim=-1)
    ways = way[:, None, None] + STEP_S * before.cumsum(-1)
    d, e = later.from_person(xs[:, None], ys[:, None], ways)
    return person_reward(scene, theta[:, None], d[:, None], e[:, None], speeds[:, None], a.expand(len(a), ahead))


def choices_now(
    situation: Situation, theta: Float[Tensor, "P 4"], action: Float[np.ndarray, "2"], rationality: float
) -> Float[Tensor, "P A"]:
    """log p(a | x, u_R, theta) for what the robot does now."""
    robot, person = situation.robot, situation.person
    values = (torch.tensor([value], dtype=torch.float64) for value in (robot.x, robot.y, robot.yaw, robot.speed))
    x, y, yaw, v = values
    first = (
        torch.tensor([float(action[0])], dtype=torch.float64),
        torch.tensor([float(action[1])], dtype=torch.float64),
    )
    here = torch.zeros(1, dtype=torch.float64), torch.tensor([person.speed], dtype=torch.float64)
    rewards = choice_rewards(situation.scene, theta, (x, y, yaw, v), (person, *here), first)
    return torch.log_softmax(rationality * rewards[0], dim=-1)


class BoltzmannDriver:
    """A person of some type, or of either with the same probability, whose weights differ a little from the type's.

    With infinite rationality they do what is best.
    """

    def __init__(self, scene: DrivingScene, kind: str, rationality: float):
        """Raises `UnknownName` for another kind of person, `InputError` for a rationality that is not positive."""
        if kind not in PEOPLE:
            raise UnknownName("person", kind, PEOPLE)
        if not rationality > 0.0:
            raise InputError(f"rationality = {rationality}: give a number above 0, inf for what is best")
        self._scene, self._kind, self._rationality = scene, kind, rationality

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, "4"]:
        """Theta of a new person."""
        names = sorted(TYPES)
        drawn = names[int(rng.integers(len(names)))]
        weights = np.array(TYPES[drawn if self._kind == "random" else self._kind])
        return weights * np.exp(SPREAD * rng.normal(size=len(weights)))

    def answer(
        self, theta: Float[np.ndarray, "4"], robot: Car, person: Car, action: Float[np.ndarray, "2"], draw: float
    ) -> float:
        """Their acceleration [m/s^2]."""
        best_only = np.isinf(self._rationality)
        situation = Situation(self._scene, robot, person)
        logs = choices_now(situation, torch.from_numpy(theta)[None], action, 1.0 if best_only else self._rationality)[0]
        if best_only:
            return float(ACCELERATIONS[int(logs.argmax())])
        chosen = int(torch.searchsorted(logs.exp().cumsum(0), draw))
        return float(ACCELERATIONS[min(chosen, len(ACCELERATIONS) - 1)])


def type_of(theta: Float[np.ndarray, "4"]) -> str:
    """The type whose weights a person's are nearest to, by standing against giving way."""
    return "aggressive" if theta[3] > theta[2] else "passive"
