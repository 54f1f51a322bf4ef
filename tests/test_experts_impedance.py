from dataclasses import replace

import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.experts.impedance import CONTROLLER, STIFFNESS_1_RAD, Impedance, Posture, Reference

FULL = np.array([80.0, 12.0])


def test_a_reference_goes_through_its_waypoints_and_rests_after_them() -> None:
    waypoints = np.array([[0.0, 1.0], [0.5, 0.0], [1.0, 2.0]])
    reference = Reference(waypoints, 2.0, begins_s=3.0, velocity=np.array([0.2, -0.1]))
    assert (reference.begins_s, reference.ends_s) == (3.0, 7.0)
    np.testing.assert_allclose(reference.positions(np.array([3.0, 5.0, 7.0, 9.0])), [*waypoints, waypoints[-1]])
    np.testing.assert_allclose(reference.at(3.0).velocity, [0.2, -0.1])
    step = 1e-5
    middle = reference.at(4.0)
    ends = reference.at(4.0 + step), reference.at(4.0 - step)
    np.testing.assert_allclose(middle.velocity, (ends[0].position - ends[1].position) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(middle.acceleration, (ends[0].velocity - ends[1].velocity) / (2 * step), rtol=1e-6)
    after = reference.at(8.0)
    assert not after.velocity.any()
    assert not after.acceleration.any()


def test_the_action_is_a_spring_a_critical_damper_and_the_inertia(lift_world) -> None:
    control = Impedance(replace(lift_world.spec, controller=CONTROLLER), FULL)
    mass, q, qd = np.array([[2.0, 0.1], [0.1, 0.5]]), np.array([0.1, 0.2]), np.array([0.0, 0.3])
    wanted = Posture(np.array([0.15, 0.1]), np.array([0.05, 0.2]), np.array([0.4, -0.2]))
    stiffness = STIFFNESS_1_RAD * FULL
    torque = stiffness * (wanted.position - q) + mass @ wanted.acceleration
    torque += 2 * np.sqrt(stiffness * np.diag(mass)) * (wanted.velocity - qd)
    np.testing.assert_allclose(control.action(wanted, q, qd, mass), torque / FULL)
    far = replace(wanted, position=np.array([50.0, -50.0]))
    np.testing.assert_array_equal(control.action(far, q, qd, mass), [1.0, -1.0])


def test_another_controller_is_refused(lift_world) -> None:
    with pytest.raises(InputError, match='make_world\\(..., controller="JOINT_TORQUE_FULL"\\)'):
        Impedance(lift_world.spec, FULL)
