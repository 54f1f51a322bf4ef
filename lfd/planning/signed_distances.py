"""Signed distances between points and the shapes of a scene, and what an arm's spheres pay for coming near.

Shapes stand in the world frame, lengths in m. A signed distance is negative inside; its slope is the unit vector
away from the nearest point of the surface, arbitrary where that is not unique (on a capsule's axis, on a box's
diagonals).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfd.planning.kinematics import compiled

FLOOR, CAPSULE, BOX = 0.0, 1.0, 2.0
ROW = 10
"""Numbers of a shape in the table that the compiled loop reads: kind, a point, another or half-lengths, radius, cosine
and sine of the yaw. A floor's height stands where a point has its z."""


@dataclass(frozen=True)
class Floor:
    """Everything below a height, such as a table's."""

    height: float
    """[m]"""

    def row(self) -> list[float]:
        return [FLOOR, 0.0, 0.0, self.height]


@dataclass(frozen=True)
class Capsule:
    """All points within a radius of a line between two points; a sphere when they are the same."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    """[m]"""

    def row(self) -> list[float]:
        return [CAPSULE, *self.start, *self.end, self.radius]


@dataclass(frozen=True)
class Box:
    """A box, turned about the vertical."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    """Half of its length along each of its own axes [m]."""
    yaw_rad: float = 0.0

    def row(self) -> list[float]:
        return [BOX, *self.centre, *self.half, 0.0, np.cos(self.yaw_rad), np.sin(self.yaw_rad)]


Shape = Floor | Capsule | Box


def table_of(shapes: Sequence[Shape]) -> Float[np.ndarray, "M 10"]:
    """Shapes as the rows that the functions below take."""
    table = np.zeros((len(shapes), ROW))
    for place, shape in zip(table, shapes, strict=True):
        row = shape.row()
        place[: len(row)] = row
    return table


def signed_distances(
    points: Float[np.ndarray, "N 3"], table: Float[np.ndarray, "M 10"]
) -> tuple[Float[np.ndarray, "N M"], Float[np.ndarray, "N M 3"]]:
    """Signed distance of each point to each shape [m], and its slope."""
    return _signed_distances(np.array(points, dtype=float), table)


def collision_penalty(
    points: Float[np.ndarray, "N P 3"], radius: Float[np.ndarray, "P"], table: Float[np.ndarray, "M 10"], margin: float
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N P 3"]]:
    """What spheres pay for coming nearer than `margin` [m], and the slopes along their centres.

    c = 1/2 sum over spheres and shapes of max(0, margin - (sd - radius))^2 [m^2], continuous with its slope.
    """
    return _penalty(points, np.array(radius), table, margin)  # a copy: numba compiles anew for read-only arrays


def clearance(
    points: Float[np.ndarray, "N P 3"], radius: Float[np.ndarray, "P"], table: Float[np.ndarray, "M 10"]
) -> Float[np.ndarray, "N"]:
    """Smallest distance between any sphere and any shape [m]: negative inside, inf without shapes."""
    distance, _ = signed_distances(points.reshape(-1, 3), table)
    return (distance.reshape(*points.shape[:2], -1) - radius[None, :, None]).min(axis=(1, 2), initial=np.inf)


@compiled
def _signed(x, y, z, row, slope):
    """Signed distance of (x, y, z) to a row's shape; writes its slope."""
    if row[0] == 0.0:  # FLOOR
        slope[0], slope[1], slope[2] = 0.0, 0.0, 1.0
        return z - row[3]
    if row[0] == 1.0:  # CAPSULE
        ax, ay, az = row[4] - row[1], row[5] - row[2], row[6] - row[3]
        px, py, pz = x - row[1], y - row[2], z - row[3]
        length = ax * ax + ay * ay + az * az
        along = min(max((px * ax + py * ay + pz * az) / length, 0.0), 1.0) if length > 0.0 else 0.0
        px, py, pz = px - along * ax, py - along * ay, pz - along * az
        away = np.sqrt(px * px + py * py + pz * pz)
        inverse = 1.0 / away if away > 0.0 else 0.0
        slope[0], slope[1], slope[2] = px * inverse, py * inverse, pz * inverse
        return away - row[7]
    c, s = row[8], row[9]  # BOX
    dx, dy = x - row[1], y - row[2]
    px, py, pz = c * dx + s * dy, c * dy - s * dx, z - row[3]
    qx, qy, qz = abs(px) - row[4], abs(py) - row[5], abs(pz) - row[6]
    if qx <= 0.0 and qy <= 0.0 and qz <= 0.0:  # inside: the nearest face
        nearest = max(qx, qy, qz)
        gx, gy, gz = 0.0, 0.0, 0.0
        if qx == nearest:
            gx = np.sign(px)
        elif qy == nearest:
            gy = np.sign(py)
        else:
            gz = np.sign(pz)
        distance = nearest
    else:
        qx, qy, qz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
        distance = np.sqrt(qx * qx + qy * qy + qz * qz)
        gx, gy, gz = np.sign(px) * qx / distance, np.sign(py) * qy / distance, np.sign(pz) * qz / distance
    slope[0], slope[1], slope[2] = c * gx - s * gy, s * gx + c * gy, gz
    return distance


@compiled
def _signed_distances(points, table):
    n, m = points.shape[0], table.shape[0]
    distance, slopes = np.empty((n, m)), np.empty((n, m, 3))
    for i in range(n):
        for j in range(m):
            distance[i, j] = _signed(points[i, 0], points[i, 1], points[i, 2], table[j], slopes[i, j])
    return distance, slopes


@compiled
def _penalty(points, radius, table, margin):
    n, count = points.shape[0], points.shape[1]
    cost, slopes, slope = np.zeros(n), np.zeros((n, count, 3)), np.empty(3)
    for i in range(n):
        for p in range(count):
            if radius[p] == 0.0:
                continue
            for j in range(table.shape[0]):
                distance = _signed(points[i, p, 0], points[i, p, 1], points[i, p, 2], table[j], slope)
                lack = margin + radius[p] - distance
                if lack > 0.0:
                    cost[i] += 0.5 * lack * lack
                    for k in range(3):
                        slopes[i, p, k] -= lack * slope[k]
    return cost, slopes
