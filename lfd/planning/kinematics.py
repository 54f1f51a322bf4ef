"""Kinematics of an arm: forward for many configurations at once, and exact gradients back to its joints.

An arm is a chain of revolute joints. With R_j, o_j the pose of joint j's frame in the world and a_j its axis,

    o_j = o_{j-1} + R_{j-1} shift_j        R_j = R_{j-1} turn_j exp([axis_j]_x q_j)        a_j = R_j axis_j

and for a point p or a direction d that joints 0..j carry

    dp / dq_j = a_j x (p - o_j)            dd / dq_j = a_j x d

so that the gradient of a cost with slopes g = dc/dp, h = dc/dd is dc/dq_j = a_j . sum (p - o_j) x g + d x h over what
joint j carries: one pass from the hand to the base, as for forces and torques. Compiled with numba; the numbers are
those of MuJoCo's mj_kinematics and mj_jac.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit

compiled = njit(nogil=True, cache=True, error_model="numpy")
GRAVITY_M_S2 = 9.81
"""robosuite's."""
GRIPPER, ELBOW, SPHERES = 0, 1, 2
"""Places in the table of points: the grip site, the elbow, the first of the spheres."""


@dataclass(frozen=True, kw_only=True)
class Arm:
    """A robot config's arm as plain arrays: D joints, and what they carry. Lengths in m, angles in rad."""

    robot: str
    """Name of the robot config."""
    low: Float[np.ndarray, "D"]
    """Lowest joint positions; -inf where a joint turns freely [rad]."""
    high: Float[np.ndarray, "D"]
    """Highest joint positions [rad]."""
    home: Float[np.ndarray, "D"]
    """The robot config's home posture [rad]."""
    torque_n_m: Float[np.ndarray, "D"]
    """Largest torque at each joint [N m]."""
    shift: Float[np.ndarray, "D 3"]
    """Origin of each joint's frame in the frame of the joint before, the first in the world's [m]."""
    turn: Float[np.ndarray, "D 3 3"]
    """R_before_joint at q = 0."""
    axis: Float[np.ndarray, "D 3"]
    """Unit axis of each joint in its own frame."""
    mass_kg: Float[np.ndarray, "D"]
    """Mass of what is fixed to each joint's frame, the gripper's with the last [kg]."""
    centre: Float[np.ndarray, "D 3"]
    """Centre of that mass in the joint's frame [m]."""
    point: Float[np.ndarray, "P 3"]
    """Points in the frames of their joints: grip site, elbow, then centres of spheres that cover the arm [m]."""
    point_joint: Int[np.ndarray, "P"]
    """The joint that carries each point."""
    radius: Float[np.ndarray, "P"]
    """Radius of the sphere around each point; 0 for grip site and elbow [m]."""
    cup_axis: Float[np.ndarray, "3"]
    """In the last joint's frame, the direction of a carried cup that should point up."""

    @property
    def joints(self) -> int:
        """How many joints the arm has."""
        return len(self.axis)


@dataclass(frozen=True)
class Poses:
    """An arm in N configurations, in the world frame."""

    origins: Float[np.ndarray, "N D 3"]
    """Of the joints' frames [m]."""
    axes: Float[np.ndarray, "N D 3"]
    """Of the joints, of unit length."""
    points: Float[np.ndarray, "N P 3"]
    """The arm's points [m]."""
    cup_axis: Float[np.ndarray, "N 3"]
    """Up, as the carried cup has it."""
    centres: Float[np.ndarray, "N D 3"]
    """Centres of the masses that the joints carry [m]."""


def forward(arm: Arm, joints: Float[np.ndarray, "N D"]) -> Poses:
    """The arm in N configurations [rad]."""
    tables = (arm.shift, arm.turn, arm.axis, arm.point, arm.point_joint, arm.cup_axis, arm.centre)
    return Poses(*_forward(np.array(joints, dtype=float), *tables))  # a copy: numba compiles anew for read-only arrays


def pull_back(
    arm: Arm, poses: Poses, point_slopes: Float[np.ndarray, "N P 3"], cup_slopes: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N D"]:
    """Gradient with respect to the joints of a cost whose slopes along points and cup axis are given."""
    tables = poses.origins, poses.axes, poses.points, poses.cup_axis, arm.point_joint
    return _pull_back(*tables, point_slopes, cup_slopes)


def gravity(arm: Arm, poses: Poses) -> tuple[Float[np.ndarray, "N D"], Float[np.ndarray, "N D D"]]:
    """Torques [N m] that hold the arm and its gripper against gravity, and their derivatives [N m/rad].

    With V the potential energy, tau_j = dV/dq_j = g sum_{i >= j} m_i z . (a_j x (c_i - o_j)) and, for k <= j,
    d tau_j / dq_k = g sum_{i >= j} m_i z . (a_k x (a_j x (c_i - o_j))), which is symmetric.
    """
    return _gravity(poses.origins, poses.axes, poses.centres, arm.mass_kg)


@compiled
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def _rotate(rotation, vector, out):
    for i in range(3):
        out[i] = rotation[i, 0] * vector[0] + rotation[i, 1] * vector[1] + rotation[i, 2] * vector[2]


@compiled
def _chain(rotation, turn, axis, angle, out):
    """out = rotation turn exp([axis]_x angle), the last by Rodrigues' formula."""
    s, c = np.sin(angle), np.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    v = 1.0 - c
    spin = np.empty((3, 3))
    spin[0, 0], spin[0, 1], spin[0, 2] = c + v * x * x, v * x * y - s * z, v * x * z + s * y
    spin[1, 0], spin[1, 1], spin[1, 2] = v * x * y + s * z, c + v * y * y, v * y * z - s * x
    spin[2, 0], spin[2, 1], spin[2, 2] = v * x * z - s * y, v * y * z + s * x, c + v * z * z
    half = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            half[i, j] = rotation[i, 0] * turn[0, j] + rotation[i, 1] * turn[1, j] + rotation[i, 2] * turn[2, j]
    for i in range(3):
        for j in range(3):
            out[i, j] = half[i, 0] * spin[0, j] + half[i, 1] * spin[1, j] + half[i, 2] * spin[2, j]


@compiled
def _forward(joints, shift, turn, axis, point, point_joint, cup_axis, centre):
    n, d, count = joints.shape[0], joints.shape[1], point.shape[0]
    origins, axes, centres = np.empty((n, d, 3)), np.empty((n, d, 3)), np.empty((n, d, 3))
    points, cups = np.empty((n, count, 3)), np.empty((n, 3))
    frames = np.empty((d + 1, 3, 3))
    frames[0] = np.eye(3)
    for row in range(n):
        for j in range(d):
            _rotate(frames[j], shift[j], origins[row, j])
            if j > 0:
                origins[row, j] += origins[row, j - 1]
            _chain(frames[j], turn[j], axis[j], joints[row, j], frames[j + 1])
            _rotate(frames[j + 1], axis[j], axes[row, j])
            _rotate(frames[j + 1], centre[j], centres[row, j])
            centres[row, j] += origins[row, j]
        for p in range(count):
            _rotate(frames[point_joint[p] + 1], point[p], points[row, p])
            points[row, p] += origins[row, point_joint[p]]
        _rotate(frames[d], cup_axis, cups[row])
    return origins, axes, points, cups, centres


@compiled
def _pull_back(origins, axes, points, cups, point_joint, point_slopes, cup_slopes):
    n, d = axes.shape[0], axes.shape[1]
    gradient = np.empty((n, d))
    turned = np.empty(3)
    forces, moments = np.empty((d, 3)), np.empty((d, 3))
    for row in range(n):
        forces[:], moments[:] = 0.0, 0.0  # sums of g and of p x g, at the joint that carries p
        for p in range(points.shape[1]):
            slope = point_slopes[row, p]
            if slope[0] != 0.0 or slope[1] != 0.0 or slope[2] != 0.0:
                _cross(points[row, p], slope, turned)
                forces[point_joint[p]] += slope
                moments[point_joint[p]] += turned
        _cross(cups[row], cup_slopes[row], turned)
        moments[d - 1] += turned
        for j in range(d - 1, -1, -1):
            if j < d - 1:
                forces[j] += forces[j + 1]
                moments[j] += moments[j + 1]
            _cross(origins[row, j], forces[j], turned)
            moment, axis = moments[j], axes[row, j]
            gradient[row, j] = (
                axis[0] * (moment[0] - turned[0])
                + axis[1] * (moment[1] - turned[1])
                + axis[2] * (moment[2] - turned[2])
            )
    return gradient


@compiled
def _gravity(origins, axes, centres, mass):
    n, d = axes.shape[0], axes.shape[1]
    torques, slopes = np.empty((n, d)), np.empty((n, d, d))
    moment, swing, swung = np.empty(3), np.empty(3), np.empty(3)
    for row in range(n):
        moment[:], total = 0.0, 0.0  # sum of m c, and of m, of what joint j carries
        for j in range(d - 1, -1, -1):
            total += mass[j]
            moment += mass[j] * centres[row, j]
            _cross(axes[row, j], GRAVITY_M_S2 * (moment - total * origins[row, j]), swing)
            torques[row, j] = swing[2]
            for k in range(j + 1):
                _cross(axes[row, k], swing, swung)
                slopes[row, j, k] = slopes[row, k, j] = swung[2]
    return torques, slopes
