import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning.deform import deform, deformation_shape


@pytest.mark.parametrize("length", [1, 2, 3, 10, 50])
def test_the_shape_is_that_of_the_dense_formula(length: int) -> None:
    second = np.zeros((length + 2, length))
    for column in range(length):
        second[column : column + 3, column] = [1.0, -2.0, 1.0]
    brute = np.linalg.inv(second.T @ second)[:, 0]
    np.testing.assert_allclose(deformation_shape(length), np.sqrt(length) * brute / np.linalg.norm(brute), rtol=1e-9)
    assert np.linalg.norm(deformation_shape(length)) == pytest.approx(np.sqrt(length))


def test_only_the_waypoints_of_the_push_move(rng: np.random.Generator) -> None:
    trajectory, push = rng.standard_normal((12, 3)), np.array([1.0, 0.0, -2.0])
    given = trajectory.copy()
    moved = deform(trajectory, index=4, push=push, length=6, scale=0.1)
    np.testing.assert_array_equal(trajectory, given)
    np.testing.assert_array_equal(moved[:4], trajectory[:4])
    np.testing.assert_array_equal(moved[10:], trajectory[10:])
    np.testing.assert_allclose(moved[4:10] - trajectory[4:10], 0.1 * np.outer(deformation_shape(6), push), atol=1e-15)


def test_up_to_the_last_waypoint(rng: np.random.Generator) -> None:
    moved = deform(np.zeros((5, 1)), index=2, push=np.ones(1), length=3, scale=1.0)
    assert (moved[2:] > 0).all()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"index": 3, "length": 3}, "index = 3 and length = 3 are not within the 5 waypoints"),
        ({"index": -1}, "index = -1"),
        ({"length": 0}, "length = 0"),
        ({"push": np.ones(3)}, "a push of shape"),
        ({"push": np.array([np.nan, 1.0])}, "must be finite"),
        ({"scale": np.inf}, "must be finite"),
    ],
)
def test_what_does_not_fit_is_refused(changes: dict, sentence: str) -> None:
    fits = {"index": 1, "push": np.ones(2), "length": 2, "scale": 1.0}
    with pytest.raises(InputError, match=sentence):
        deform(np.zeros((5, 2)), **(fits | changes))


def test_a_trajectory_of_one_dimension_is_refused() -> None:
    with pytest.raises(InputError, match=r"give \(T, D\)"):
        deform(np.zeros(5), index=0, push=np.ones(1), length=1, scale=1.0)
