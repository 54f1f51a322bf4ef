import numpy as np
import pytest

from lfd.planning.signed_distances import Box, Capsule, Floor, clearance, collision_penalty, signed_distances, table_of

SHAPES = (
    Floor(0.2),
    Capsule((0.0, 0.0, -0.5), (0.1, 0.3, 0.6), 0.2),
    Capsule((0.4, 0.4, 0.4), (0.4, 0.4, 0.4), 0.3),
    Box((0.1, -0.2, 0.3), (0.3, 0.2, 0.1), 0.7),
)


def brute(shape: Floor | Capsule | Box, points: np.ndarray) -> np.ndarray:
    """Signed distances by looking for the nearest of many points of the shape's surface or axis."""
    if isinstance(shape, Floor):
        return points[:, 2] - shape.height
    if isinstance(shape, Capsule):
        axis = np.linspace(shape.start, shape.end, 20001)
        return np.array([np.linalg.norm(point - axis, axis=1).min() for point in points]) - shape.radius
    grid = np.linspace(-1, 1, 401)
    u, v = (side.ravel() for side in np.meshgrid(grid, grid))
    faces = []
    for along in range(3):
        for side in (-1.0, 1.0):
            face = np.empty((len(u), 3))
            face[:, along], face[:, (along + 1) % 3], face[:, (along + 2) % 3] = side, u, v
            faces.append(face * shape.half)
    surface = np.concatenate(faces)
    c, s = np.cos(shape.yaw_rad), np.sin(shape.yaw_rad)
    local = (points - shape.centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    away = np.array([np.linalg.norm(point - surface, axis=1).min() for point in local])
    return np.where((np.abs(local) < shape.half).all(axis=1), -away, away)


def test_distances_are_those_to_the_nearest_of_many_points(rng: np.random.Generator) -> None:
    points = rng.uniform(-0.5, 0.6, (60, 3))
    distance, _ = signed_distances(points, table_of(SHAPES))
    for column, shape in enumerate(SHAPES):
        np.testing.assert_allclose(distance[:, column], brute(shape, points), atol=2e-4)  # the points' density
    assert (distance < 0).any(axis=0).all()


def test_slopes_are_differences_and_of_length_one(rng: np.random.Generator) -> None:
    points, table, step = rng.uniform(-0.8, 0.8, (200, 3)), table_of(SHAPES), 1e-6
    _, slopes = signed_distances(points, table)
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=2), 1.0, atol=1e-12)
    for axis in range(3):
        more, less = (signed_distances(points + sign * step * np.eye(3)[axis], table)[0] for sign in (1, -1))
        np.testing.assert_allclose(slopes[..., axis], (more - less) / (2 * step), atol=1e-6)


def test_the_penalty_and_its_slopes(rng: np.random.Generator) -> None:
    points, radius, table, step = (
        rng.uniform(-0.8, 0.8, (6, 5, 3)),
        np.array([0.0, 0.1, 0.05, 0.2, 0.1]),
        table_of(SHAPES),
        1e-6,
    )
    cost, slopes = collision_penalty(points, radius, table, 0.03)
    distance, _ = signed_distances(points.reshape(-1, 3), table)
    lack = np.maximum(
        0.0, 0.03 + radius[None, 1:, None] - distance.reshape(6, 5, -1)[:, 1:]
    )  # a point without radius is free
    np.testing.assert_allclose(cost, 0.5 * (lack**2).sum(axis=(1, 2)), atol=1e-14)
    for point, axis in np.ndindex(5, 3):
        aside = np.zeros_like(points)
        aside[:, point, axis] = step
        more, less = (collision_penalty(points + sign * aside, radius, table, 0.03)[0] for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, point, axis], (more - less) / (2 * step), atol=1e-8)


def test_clearance_is_that_of_the_nearest_sphere() -> None:
    points, radius = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.5]]]), np.array([0.6, 0.2])
    assert clearance(points, radius, table_of((Floor(0.2),))) == pytest.approx([0.1])
    assert clearance(points, radius, table_of(())) == [np.inf]
