"""Deformation of a trajectory by a push: it yields where it is pushed, and smoothly from there on."""

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded

from lfd.core.errors import InputError


def deform(
    trajectory: Float[np.ndarray, "T D"], *, index: int, push: Float[np.ndarray, "D"], length: int, scale: float
) -> Float[np.ndarray, "T D"]:
    """The trajectory with its `length` waypoints from `index` on moved by scale H push^T.

    With A the second differences of n = `length` waypoints between zeros (n + 2 rows) and R = A^T A, minimising
    1/2 |A d|^2 - d . e_1 u for a push u at the first of them gives d = R^-1 e_1 u, whose shape is kept and whose size
    does not depend on n (Losey and O'Malley, Trajectory Deformations From Physical Human-Robot Interaction, 2018):

        H = sqrt(n) R^-1 e_1 / |R^-1 e_1|

    Of `push`, the units of `scale` make units of the waypoints. Other waypoints are returned as they are. Raises
    `InputError` when the deformed part is not within the trajectory, for shapes that do not fit and numbers that are
    not finite.
    """
    if trajectory.ndim != 2 or np.shape(push) != trajectory.shape[1:]:
        raise InputError(
            f"a trajectory of shape {trajectory.shape} and a push of shape {np.shape(push)}; give (T, D) and (D,)"
        )
    if index < 0 or length < 1 or index + length > len(trajectory):
        raise InputError(
            f"index = {index} and length = {length} are not within the {len(trajectory)} waypoints; "
            "give index >= 0, length >= 1 and index + length <= T"
        )
    if not (np.isfinite(trajectory).all() and np.isfinite(push).all() and np.isfinite(scale)):
        raise InputError(f"trajectory, push {push} and scale {scale} must be finite numbers")
    deformed = np.array(trajectory, dtype=float)
    deformed[index : index + length] += scale * np.outer(deformation_shape(length), push)
    return deformed


def deformation_shape(length: int) -> Float[np.ndarray, "N"]:
    """H above: how far each of `length` waypoints goes with a push at the first; |H| = sqrt(length)."""
    bands = np.repeat([[6.0], [-4.0], [1.0]], length, axis=1)  # of R = A^T A, which has no other entries
    first = np.zeros(length)
    first[0] = 1.0
    shape = solveh_banded(bands[: min(3, length)], first, lower=True)
    return np.sqrt(length) * shape / np.linalg.norm(shape)
