"""Units of a source: how they become SI, and when a declared one cannot be true."""

from dataclasses import dataclass
from math import pi

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Unit:
    """A unit that a recipe may declare."""

    dimension: str
    """What it measures, as messages say it: angle, length, force."""
    si: str
    """The unit of the rows that are made of it."""
    factor: float
    """Size of one in the SI unit."""


_TABLE: tuple[tuple[str, str, dict[str, float]], ...] = (
    ("angle", "rad", {"rad": 1.0, "mrad": 1e-3, "deg": pi / 180, "turn": 2 * pi}),
    ("length", "m", {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3, "inch": 0.0254}),
    ("angular velocity", "rad/s", {"rad/s": 1.0, "deg/s": pi / 180, "rpm": pi / 30}),
    ("velocity", "m/s", {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6}),
    ("angular acceleration", "rad/s^2", {"rad/s^2": 1.0, "deg/s^2": pi / 180}),
    ("acceleration", "m/s^2", {"m/s^2": 1.0, "mm/s^2": 1e-3, "g0": 9.80665}),
    ("torque", "N m", {"N m": 1.0, "Nm": 1.0, "mN m": 1e-3, "mNm": 1e-3}),
    ("force", "N", {"N": 1.0, "mN": 1e-3, "kN": 1e3}),
    ("time", "s", {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}),
    ("mass", "kg", {"kg": 1.0, "g": 1e-3}),
    ("frequency", "Hz", {"Hz": 1.0, "kHz": 1e3}),
    ("current", "A", {"A": 1.0, "mA": 1e-3}),
    ("voltage", "V", {"V": 1.0, "mV": 1e-3}),
    ("pressure", "Pa", {"Pa": 1.0, "kPa": 1e3, "bar": 1e5}),
    ("temperature", "K", {"K": 1.0}),
    ("ratio", "1", {"1": 1.0, "%": 1e-2}),
    ("controller input", "controller", {"controller": 1.0}),
    ("flag", "bool", {"bool": 1.0}),
)
UNITS: dict[str, Unit] = {
    name: Unit(dimension, si, factor) for dimension, si, row in _TABLE for name, factor in row.items()
}

LARGEST: dict[str, tuple[float, str, str]] = {
    "rad": (4 * pi, "degrees", "deg"),
    "rad/s": (50.0, "degrees a second", "deg/s"),
    "m": (100.0, "millimetres", "mm"),
    "m/s": (20.0, "millimetres a second", "mm/s"),
}
"""Unit to the size that no arm reaches, what larger numbers look like, and its unit."""
SMALLEST: dict[str, tuple[float, str, str]] = {
    "deg": (2 * pi, "radians", "rad"),
    "mm": (1.0, "metres", "m"),
}
"""Unit to the size that some number exceeds if the unit is right, what smaller ones look like, and its unit."""


def suspicion(values: Float[np.ndarray, "N D"], unit: str, *, absolute: bool) -> tuple[int, str, str] | None:
    """Why `values` can hardly be in `unit`: row of the proof, a sentence, the unit that they look like.

    Judged by size: joint positions beyond two turns look like degrees, positions beyond 100 m like millimetres;
    angles in degrees that all stay below 2 pi look like radians. The latter is said of `absolute` numbers only, a
    position by the type's definition, since steps of an action may be small. Zeros say nothing.
    """
    sizes = np.abs(values).max(axis=1)
    row = int(sizes.argmax())
    if unit in LARGEST and sizes[row] > LARGEST[unit][0]:
        limit, looks, better = LARGEST[unit]
        return row, f"{sizes[row]:.6g} is more than {limit:.4g} {unit}, it looks like {looks}", better
    if absolute and unit in SMALLEST and 0 < sizes[row] <= SMALLEST[unit][0]:
        limit, looks, better = SMALLEST[unit]
        return row, f"no number exceeds {limit:.4g} {unit}, they look like {looks}", better
    return None


_POSE = {"position": ("length",), "orientation": ("ratio",)}
_TWIST = {"linear": ("velocity",), "angular": ("angular velocity",)}
_ACCEL = {"linear": ("acceleration",), "angular": ("angular acceleration",)}
_WRENCH = {"force": ("force",), "torque": ("torque",)}
_TRANSFORM = {"translation": ("length",), "rotation": ("ratio",)}


def _under(member: str, fields: dict[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    return {f"{member}.{field}": dimensions for field, dimensions in fields.items()}


DEFINED: dict[str, dict[str, tuple[str, ...]]] = {
    "sensor_msgs/JointState": {
        "position": ("angle", "length"),
        "velocity": ("angular velocity", "velocity"),
        "effort": ("torque", "force"),
    },
    "sensor_msgs/Imu": {
        "orientation": ("ratio",),
        "angular_velocity": ("angular velocity",),
        "linear_acceleration": ("acceleration",),
    },
    "sensor_msgs/Range": {"range": ("length",)},
    "geometry_msgs/Point": {"": ("length",)},
    "geometry_msgs/PointStamped": {"point": ("length",)},
    "geometry_msgs/Quaternion": {"": ("ratio",)},
    "geometry_msgs/QuaternionStamped": {"quaternion": ("ratio",)},
    "geometry_msgs/Pose": _POSE,
    "geometry_msgs/PoseStamped": _under("pose", _POSE),
    "geometry_msgs/PoseArray": _under("poses", _POSE),
    "geometry_msgs/PoseWithCovariance": _under("pose", _POSE),
    "geometry_msgs/PoseWithCovarianceStamped": _under("pose.pose", _POSE),
    "geometry_msgs/Twist": _TWIST,
    "geometry_msgs/TwistStamped": _under("twist", _TWIST),
    "geometry_msgs/TwistWithCovarianceStamped": _under("twist.twist", _TWIST),
    "geometry_msgs/Accel": _ACCEL,
    "geometry_msgs/AccelStamped": _under("accel", _ACCEL),
    "geometry_msgs/Wrench": _WRENCH,
    "geometry_msgs/WrenchStamped": _under("wrench", _WRENCH),
    "geometry_msgs/Transform": _TRANSFORM,
    "geometry_msgs/TransformStamped": _under("transform", _TRANSFORM),
    "tf2_msgs/TFMessage": _under("transforms.transform", _TRANSFORM),
    "nav_msgs/Odometry": _under("pose.pose", _POSE) | _under("twist.twist", _TWIST),
    "foxglove.Pose": _POSE,
    "foxglove.PoseInFrame": _under("pose", _POSE),
    "foxglove.FrameTransform": _TRANSFORM,
}
"""Message type to field to the dimensions that it has by definition (REP 103, the comments in the definitions)."""


def defined_dimensions(message_type: str, field: str) -> tuple[str, ...]:
    """The dimensions that a field (dotted, without indices) has by its type's definition; none where it has none."""
    fields = DEFINED.get(message_type.replace("/msg/", "/"), {})
    found = [name for name in fields if not name or field == name or field.startswith(f"{name}.")]
    return fields[max(found, key=len)] if found else ()
