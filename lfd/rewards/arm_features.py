"""Features of an arm's motion: named plain functions with units, and their exact slopes.

A feature is a function of some *channels* of B trajectories of T waypoints, dt apart: where the gripper is, how fast
the joints turn. It gives its value at every row and the slope of that value along each of its channels. `STATE`
features have a row at each waypoint, `STEP` features one for each step between two. A trajectory's feature count is

    f = dt (phi_0 / 2 + phi_1 + ... + phi_{T-2} + phi_{T-1} / 2)   of STATE features, the trapezoid rule,
    f = dt (phi_0 + ... + phi_{T-2})                               of STEP features:

the integral of the feature over time (its unit times s), which does not depend on the number of waypoints but for
O(dt^2). The same as sums over T - 1 decisions, undiscounted: `decision_rows`.

Distances that should matter only nearby are *closenesses*, 1 at the place and 0 beyond a radius R, with slopes that
are continuous everywhere: max(0, 1 - d^2/R^2)^2.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError, UnknownName

STATE, STEP = "state", "step"
SOFT = 1e-3
"""What smooths lengths at 0, |x| ~ sqrt(x^2 + SOFT^2) - SOFT [m] or [m/s]: off by SOFT at most."""

Rows = Float[np.ndarray, "B N"]
Vectors = Float[np.ndarray, "B N 3"]
Joints = Float[np.ndarray, "B N D"]


@dataclass(frozen=True)
class Spot:
    """A place that one can be near to."""

    centre: Float[np.ndarray, "3"]
    """In the world frame [m]."""
    radius: float
    """Distance from which on one is not near [m]."""


@dataclass(frozen=True, kw_only=True)
class Places:
    """What features refer to, in the world frame [m]."""

    table_height: float
    person: Spot
    """The person's chest."""
    laptop: Spot
    obstacle: Spot | None = None
    """Another thing to stay away from."""
    goal: Float[np.ndarray, "3"]
    """Where the gripper should end."""


@dataclass(frozen=True)
class ArmFeature:
    """A row of the table of features."""

    name: str
    unit: str
    """Of the value; a feature count has this unit times s."""
    rows: str
    """STATE or STEP."""
    channels: tuple[str, ...]
    """What the function takes after the places, in this order."""
    function: Callable[..., tuple[Rows, tuple[np.ndarray, ...]]]


def table_distance(places: Places, gripper: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """Height of the gripper above the table [m]."""
    return gripper[..., 2] - places.table_height, (_up(gripper),)


def elbow_table_distance(places: Places, elbow: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """Height of the elbow above the table [m]."""
    return elbow[..., 2] - places.table_height, (_up(elbow),)


def person_closeness(places: Places, gripper: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """How near the gripper is to the person's chest, 0 to 1."""
    return _closeness(gripper - places.person.centre, places.person.radius)


def elbow_person_closeness(places: Places, elbow: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """How near the elbow is to the person's chest, 0 to 1."""
    return _closeness(elbow - places.person.centre, places.person.radius)


def laptop_closeness(places: Places, gripper: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """How near the gripper is to being above the laptop, 0 to 1; height does not matter (Bajcsy et al. 2017)."""
    return _closeness((gripper - places.laptop.centre) * np.array([1.0, 1.0, 0.0]), places.laptop.radius)


def obstacle_closeness(places: Places, gripper: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """How near the gripper is to the scene's obstacle, 0 to 1. Raises `InputError` in a scene without one."""
    if places.obstacle is None:
        raise InputError("obstacle_closeness needs a scene with an obstacle; give its Places an `obstacle`")
    return _closeness(gripper - places.obstacle.centre, places.obstacle.radius)


def cup_tilt(_places: Places, cup_axis: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """How far the carried cup is from upright: 1 - cos of the angle, 0 upright, 1 lying, 2 upside down."""
    return 1.0 - cup_axis[..., 2], (-_up(cup_axis),)


def goal_distance(places: Places, gripper: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """Distance of the gripper to its goal [m]."""
    return _length(gripper - places.goal)


def gripper_speed(_places: Places, gripper_velocity: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """Square of the gripper's speed [m^2/s^2]."""
    return _square(gripper_velocity)


def path_length(_places: Places, gripper_velocity: Vectors) -> tuple[Rows, tuple[Vectors]]:
    """The gripper's speed [m/s], whose integral is the length of its path [m]."""
    return _length(gripper_velocity)


def joint_speed(_places: Places, joint_velocity: Joints) -> tuple[Rows, tuple[Joints]]:
    """Sum of the squares of the joints' speeds [rad^2/s^2], the efficiency of Bajcsy et al. 2017."""
    return _square(joint_velocity)


def joint_effort(_places: Places, holding_torque: Joints) -> tuple[Rows, tuple[Joints]]:
    """Sum over the joints of (torque against gravity / largest torque)^2: what holding still there takes."""
    return _square(holding_torque)


def joint_jerk(_places: Places, joint_jerk: Joints) -> tuple[Rows, tuple[Joints]]:
    """Sum of the squares of the joints' jerks [rad^2/s^6]; those of the first and last step count as 0."""
    return _square(joint_jerk)


def table_force(forces: Float[np.ndarray, "*rows 3"]) -> Float[np.ndarray, "*rows"]:
    """Magnitude of recorded contact forces with the table [N]. Only of recordings: a planner has no contacts."""
    return np.linalg.norm(forces, axis=-1)


ARM_FEATURES: dict[str, ArmFeature] = {
    feature.name: feature
    for feature in (
        ArmFeature("table_distance", "m", STATE, ("gripper",), table_distance),
        ArmFeature("elbow_table_distance", "m", STATE, ("elbow",), elbow_table_distance),
        ArmFeature("person_closeness", "1", STATE, ("gripper",), person_closeness),
        ArmFeature("elbow_person_closeness", "1", STATE, ("elbow",), elbow_person_closeness),
        ArmFeature("laptop_closeness", "1", STATE, ("gripper",), laptop_closeness),
        ArmFeature("obstacle_closeness", "1", STATE, ("gripper",), obstacle_closeness),
        ArmFeature("cup_tilt", "1", STATE, ("cup_axis",), cup_tilt),
        ArmFeature("goal_distance", "m", STATE, ("gripper",), goal_distance),
        ArmFeature("gripper_speed", "m^2/s^2", STEP, ("gripper_velocity",), gripper_speed),
        ArmFeature("path_length", "m/s", STEP, ("gripper_velocity",), path_length),
        ArmFeature("joint_speed", "rad^2/s^2", STEP, ("joint_velocity",), joint_speed),
        ArmFeature("joint_effort", "1", STATE, ("holding_torque",), joint_effort),
        ArmFeature("joint_jerk", "rad^2/s^6", STEP, ("joint_jerk",), joint_jerk),
    )
}
"""Features by name."""
CHANNELS = {
    "joints": "rad",
    "gripper": "m",
    "elbow": "m",
    "cup_axis": "1",
    "holding_torque": "1",
    "gripper_velocity": "m/s",
    "joint_velocity": "rad/s",
    "joint_jerk": "rad/s^3",
}
"""Channels and their units, all in the world frame. `holding_torque` is a fraction of the largest."""


def arm_features(names: Sequence[str]) -> tuple[ArmFeature, ...]:
    """The features of some names.

    Raises `UnknownName` with the names of all features, `InputError` for none or a name given twice.
    """
    if not names or len(set(names)) < len(names):
        raise InputError(f"give one feature or more, each once, not {tuple(names)}; known: {', '.join(ARM_FEATURES)}")
    for name in names:
        if name not in ARM_FEATURES:
            raise UnknownName("arm feature", name, ARM_FEATURES)
    return tuple(ARM_FEATURES[name] for name in names)


def decision_rows(
    features: Sequence[ArmFeature], places: Places, channels: Mapping[str, np.ndarray], dt_s: float
) -> Float[np.ndarray, "B N K"]:
    """What each of the N = T - 1 decisions adds to the feature counts: f is their undiscounted sum.

    `channels` may come from the planner's kinematics or from recordings. A step has the mean of the STATE features at
    its two ends.
    """
    columns = []
    for feature in features:
        value, _ = feature.function(places, *(channels[name] for name in feature.channels))
        columns.append(0.5 * (value[:, :-1] + value[:, 1:]) if feature.rows == STATE else value)
    return dt_s * np.stack(columns, axis=-1)


def _up(vectors: Vectors) -> Vectors:
    slope = np.zeros_like(vectors)
    slope[..., 2] = 1.0
    return slope


def _closeness(away: Vectors, radius: float) -> tuple[Rows, tuple[Vectors]]:
    """max(0, 1 - |away|^2 / radius^2)^2."""
    near = np.maximum(0.0, 1.0 - np.einsum("...i,...i", away, away) / radius**2)
    return near**2, ((-4.0 / radius**2) * near[..., None] * away,)


def _length(vectors: np.ndarray) -> tuple[Rows, tuple[np.ndarray]]:
    """sqrt(|x|^2 + SOFT^2) - SOFT."""
    soft = np.sqrt(np.einsum("...i,...i", vectors, vectors) + SOFT**2)
    return soft - SOFT, (vectors / soft[..., None],)


def _square(vectors: np.ndarray) -> tuple[Rows, tuple[np.ndarray]]:
    return np.einsum("...i,...i", vectors, vectors), (2.0 * vectors,)
