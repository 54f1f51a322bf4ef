"""The messages of a topic as columns of numbers.

All messages of a topic of ours have the same names and sizes, so the numbers of all are taken in one operation
(`lfd.record.layouts`); where they differ, they are unpacked one by one.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from lfd.record import cdr
from lfd.record.layouts import Layout, Pack

Messages = Sequence[bytes]


def arrays(messages: Messages) -> tuple[tuple[str, ...], Float[np.ndarray, "N D"]]:
    """std_msgs/Float64MultiArray: names of the components, and a row for each message.

    Raises `ValueError` when sizes differ.
    """
    names, first = cdr.unpack_array(messages[0])
    rows = _read(messages, array_layout(names, len(first)), lambda data: cdr.unpack_array(data)[1])
    return names, rows


def joint_states(messages: Messages) -> tuple[tuple[str, ...], Float[np.ndarray, "N 3 J"]]:
    """sensor_msgs/JointState: names of the joints, and position, velocity and effort of each in each message.

    Raises `ValueError` when a message lacks one of the three, or names differ.
    """
    first = cdr.unpack_joint_state(messages[0])
    joints = len(first.name)
    for name in ("position", "velocity", "effort"):
        if len(getattr(first, name)) != joints:
            raise ValueError(f"a JointState has {joints} names and {len(getattr(first, name))} numbers for {name}")

    def unpack(data: bytes) -> np.ndarray:
        state = cdr.unpack_joint_state(data)
        if state.name != first.name:
            raise ValueError(f"the joints of a JointState change from {first.name} to {state.name}")
        return np.concatenate([state.position, state.velocity, state.effort])

    return first.name, _read(messages, joint_state_layout(first.name), unpack).reshape(-1, 3, joints)


def poses(messages: Messages) -> Float[np.ndarray, "N 7"]:
    """geometry_msgs/PoseStamped: position [m] and quaternion xyzw of each message."""
    return _read(messages, pose_layout(), lambda data: np.concatenate(cdr.unpack_pose(data)))


def _read(messages: Messages, layout: Layout, unpack: Callable[[bytes], np.ndarray]) -> np.ndarray:
    rows = layout.read(messages)
    if rows is None:
        rows, size = np.array([unpack(data) for data in messages]), layout.numbers.size // 8
        if rows.shape[1:] != (size,):
            raise ValueError(f"messages have {rows.shape[1:]} numbers, the first has {size}")
    return rows


@lru_cache(maxsize=64)
def array_layout(components: tuple[str, ...], size: int) -> Layout:
    """Where the numbers of an array stand; there may be one name for all of them."""
    return Layout.of(array_pack(components), size)


@lru_cache(maxsize=64)
def joint_state_layout(names: tuple[str, ...]) -> Layout:
    """Where positions, velocities and efforts of a JointState stand."""
    return Layout.of(joint_state_pack(names), 3 * len(names))


@lru_cache(maxsize=1)
def pose_layout() -> Layout:
    """Where position and quaternion xyzw of a PoseStamped stand."""
    return Layout.of(pose_pack, 7)


def array_pack(components: Sequence[str]) -> Pack:
    """Packs a std_msgs/Float64MultiArray of named components."""

    def pack(time_ns: int, numbers: np.ndarray) -> bytes:
        del time_ns  # an array has no stamp
        return cdr.pack_array(components, numbers)

    return pack


def joint_state_pack(names: tuple[str, ...]) -> Pack:
    """Packs a sensor_msgs/JointState from positions, velocities and efforts."""

    def pack(time_ns: int, numbers: np.ndarray) -> bytes:
        return cdr.pack_joint_state(time_ns, cdr.JointState(names, *np.split(numbers, 3)))

    return pack


def pose_pack(time_ns: int, numbers: np.ndarray) -> bytes:
    """Packs a geometry_msgs/PoseStamped from position and quaternion xyzw."""
    return cdr.pack_pose(time_ns, numbers[:3], numbers[3:])


def transforms_pack(names: Sequence[str]) -> Pack:
    """Packs a tf2_msgs/TFMessage from position and quaternion xyzw of each child frame."""

    def pack(time_ns: int, numbers: np.ndarray) -> bytes:
        rows = numbers.reshape(-1, 7)
        return cdr.pack_transforms(time_ns, [(n, row[:3], row[3:]) for n, row in zip(names, rows, strict=True)])

    return pack
