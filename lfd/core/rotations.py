"""Rotations as unit quaternions in wxyz order (scalar first), the order of MuJoCo.

ROS messages and robosuite use xyzw; adapters convert with the two functions below and nobody else does.
"""

import numpy as np
from jaxtyping import Float, Shaped


def xyzw_from_wxyz(quat: Shaped[np.ndarray, "*batch 4"]) -> Shaped[np.ndarray, "*batch 4"]:
    """Quaternion with the scalar moved to the end."""
    return np.roll(quat, -1, axis=-1)


def wxyz_from_xyzw(quat: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Quaternion with the scalar moved to the front."""
    return np.roll(quat, 1, axis=-1)


def matrix_from_wxyz(quat: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a unit quaternion; its columns are the rotated axes."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotvec_between(matrix: Float[np.ndarray, "3 3"], target: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Rotation vector [rad] in the world frame that turns `matrix` into `target`.

    exp([r]_x) matrix = target, |r| <= pi. At |r| = pi the sign of the axis is arbitrary.
    """
    r = target @ matrix.T
    axis = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine, cosine = np.linalg.norm(axis), 0.5 * (np.trace(r) - 1.0)
    if sine > 1e-6:
        return axis * (np.arctan2(sine, cosine) / sine)
    if cosine > 0:
        return axis
    symmetric = 0.5 * (r + np.eye(3))  # = axis axis^T at half a turn
    column = symmetric[:, np.argmax(np.diag(symmetric))]
    return np.pi * column / np.linalg.norm(column)
