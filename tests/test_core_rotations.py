import mujoco
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lfd.core.rotations import matrix_from_wxyz, rotvec_between, wxyz_from_xyzw, xyzw_from_wxyz

unit_quaternions = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(rng=np.random.default_rng(seed)))


@given(unit_quaternions)
def test_orders_of_quaternions_agree_with_scipy_and_mujoco(rotation: Rotation) -> None:
    wxyz, xyzw = rotation.as_quat(scalar_first=True), rotation.as_quat()
    np.testing.assert_array_equal(xyzw_from_wxyz(wxyz), xyzw)
    np.testing.assert_array_equal(wxyz_from_xyzw(xyzw), wxyz)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, wxyz)
    np.testing.assert_allclose(matrix_from_wxyz(wxyz), matrix.reshape(3, 3), atol=1e-12)


@given(unit_quaternions, unit_quaternions)
def test_rotvec_turns_one_rotation_into_the_other(start: Rotation, end: Rotation) -> None:
    rotvec = rotvec_between(start.as_matrix(), end.as_matrix())
    assert np.linalg.norm(rotvec) <= np.pi + 1e-9
    turned = Rotation.from_rotvec(rotvec) * start
    np.testing.assert_allclose(turned.as_matrix(), end.as_matrix(), atol=1e-6)


def test_rotvec_of_no_turn_and_of_half_a_turn() -> None:
    np.testing.assert_allclose(rotvec_between(np.eye(3), np.eye(3)), 0, atol=1e-15)
    for axis in np.eye(3):
        half = Rotation.from_rotvec(np.pi * axis).as_matrix()
        np.testing.assert_allclose(np.abs(rotvec_between(np.eye(3), half)), np.pi * axis, atol=1e-6)
