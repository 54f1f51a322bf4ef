"""Keeps a way out for a robot at the wheel: it relies on what people do, not on what it expects them to do.

A plan counts on the person's best response, such as hard braking; a person who chooses otherwise may leave the robot
where no control avoids a crash. So an action is carried out only if, after it, some manoeuvre m of `Manoeuvres` keeps

    min_t  distance(robot along m at t, others at their present speed at t)  >=  MARGIN_M

for `AHEAD_S`: to stop, or to speed up, on the line where it is, on its first one, or on the road's. Otherwise the
manoeuvre nearest to the plan that does so from now on is begun, or the one of the greatest distance (compare fail-safe
trajectories, Pek and Althoff 2018). It is looked for again in every step. That is no proof: people may speed up, and a
way out is looked for over `AHEAD_S` only.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lfd.worlds.driving_world import ACTION_HIGH, ACTION_LOW, LENGTH, WHEELBASE, WIDTH, Car

MARGIN_M = 0.3
"""Between outlines [m]."""
AHEAD_S = 4.0
"""For how long [s]."""
ACCELERATIONS = (-5.0, -2.0, 0.0, 3.0)
"""Of manoeuvres [m/s^2]."""
DISCS = np.array([-LENGTH / 3.0, 0.0, LENGTH / 3.0]) + WHEELBASE / 2.0
"""A car is within three discs, whose centres are so far ahead of its rear axle [m]."""
DISC_M = float(np.hypot(LENGTH / 6.0, WIDTH / 2.0))
"""Their radius [m]."""


Number = float | np.ndarray
"""One, or as many as there are manoeuvres."""


def steering_to(line: Number, y: Number, yaw: Number, speed: Number, step_s: float) -> Number:
    """Steering angle [rad] that leads onto the line beside the road's that is at y = `line`, in about 1.5 s."""
    wanted = np.clip((line - y) / (1.5 * speed + 1.0), -0.2, 0.2)
    turn = (wanted - yaw) * WHEELBASE / (step_s * np.maximum(speed, 1.0))
    return np.clip(np.arctan(turn), ACTION_LOW[1], ACTION_HIGH[1])


class Manoeuvres:
    """Each acceleration on each line, from where a car is."""

    def __init__(self, car: Car, lines: Sequence[float], dt: float):
        """`lines` are places beside the road's line, y [m]; dt is the control step [s]."""
        self._dt = dt
        acceleration, line = (grid.ravel() for grid in np.meshgrid(ACCELERATIONS, lines, indexing="ij"))
        x, y, yaw, speed = (np.full(len(line), value) for value in (car.x, car.y, car.yaw, car.speed))
        rows = []
        for number in range(round(AHEAD_S / dt)):
            steering = steering_to(line, y, yaw, speed, dt)
            if number == 0:
                self.first = np.column_stack([acceleration, steering])
            x, y, yaw, speed = (
                x + speed * np.cos(yaw) * dt,
                y + speed * np.sin(yaw) * dt,
                yaw + speed * np.tan(steering) / WHEELBASE * dt,
                np.maximum(speed + acceleration * dt, 0.0),
            )
            rows.append(np.stack([x, y, yaw], axis=-1))
        self._ways = np.stack(rows, axis=1)

    first: Float[np.ndarray, "M 2"]
    """The action that each begins with."""

    def distances(self, others: Sequence[Car]) -> Float[np.ndarray, "M"]:
        """Least distance of each from cars that keep their speed [m]; below 0 where discs overlap."""
        own = discs(self._ways)
        times = self._dt * np.arange(1, own.shape[1] + 1)
        least = np.full(len(own), np.inf)
        for car in others:
            ways = times[:, None] * car.speed * np.array([np.cos(car.yaw), np.sin(car.yaw), 0.0])
            there = discs(np.array([car.x, car.y, car.yaw]) + ways)
            apart = np.linalg.norm(own[:, :, :, None] - there[None, :, None], axis=-1)
            least = np.minimum(least, apart.min(axis=(1, 2, 3)))
        return least - 2.0 * DISC_M


def discs(poses: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3 2"]:
    """Centres of the discs, from x, y and yaw of the rear axle."""
    x, y, yaw = (poses[..., i, None] for i in range(3))
    return np.stack([x + DISCS * np.cos(yaw), y + DISCS * np.sin(yaw)], axis=-1)


def with_a_way_out(
    action: Float[np.ndarray, "2"], robot: Car, others: Sequence[Car], first_line: float, dt: float
) -> Float[np.ndarray, "2"]:
    """The action, if it leaves a way out, or else one that does."""
    after = robot.moved(float(action[0]), float(action[1]), dt)
    later = [car.moved(0.0, 0.0, dt) for car in others]
    if Manoeuvres(after, (after.y, first_line, 0.0), dt).distances(later).max() >= MARGIN_M:
        return action
    now = Manoeuvres(robot, (robot.y, first_line, 0.0), dt)
    distances = now.distances(others)
    if distances.max() < MARGIN_M:
        return now.first[int(distances.argmax())]
    away = np.linalg.norm((now.first - action) / (ACTION_HIGH - ACTION_LOW), axis=1)
    return now.first[int(np.where(distances >= MARGIN_M, away, np.inf).argmin())]
