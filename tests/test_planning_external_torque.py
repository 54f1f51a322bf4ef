"""The momentum observer against the physics of a small arm, whose equations MuJoCo integrates."""

import mujoco
import numpy as np
import pytest

from lfd.core.errors import InputError
from lfd.planning.external_torque import ArmDynamics, MomentumObserver

ARM = """
<mujoco>
  <option timestep="0.0005" integrator="RK4"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.04" mass="2"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="elbow" axis="0 1 0" armature="0.05"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
JOINTS = ("shoulder", "elbow")
GAIN, EVERY = 40.0, 4


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


def test_mass_and_bias_are_mujocos(model, rng) -> None:
    dynamics, data = ArmDynamics(model, JOINTS), mujoco.MjData(model)
    for _ in range(5):
        data.qpos[:], data.qvel[:] = rng.normal(size=2), rng.normal(size=2)
        mujoco.mj_forward(model, data)
        full = np.empty((2, 2))
        mujoco.mj_fullM(model, full, data.qM)
        mass, bias = dynamics.mass_and_bias(data.qpos, data.qvel)
        np.testing.assert_allclose(mass, full, atol=1e-12)
        np.testing.assert_allclose(bias, data.qfrc_bias - data.qfrc_passive, atol=1e-12)


def test_the_rate_of_the_mass_is_that_of_a_planar_arm(model) -> None:
    """M11 = a + 2 b cos q2, M12 = c + b cos q2 with b = m2 l1 lc2: dM/dt = -b sin(q2) qd2 [[2, 1], [1, 0]]."""
    q, qd = np.array([0.3, 0.7]), np.array([-0.4, 1.1])
    wanted = -1.0 * 0.4 * 0.15 * np.sin(q[1]) * qd[1] * np.array([[2.0, 1.0], [1.0, 0.0]])
    np.testing.assert_allclose(ArmDynamics(model, JOINTS).mass_rate(q, qd), wanted, atol=1e-8)


@pytest.mark.parametrize("pushed", [0, 1])
def test_the_residual_follows_a_push_as_a_first_order_filter_would(model, pushed) -> None:
    """A swinging arm, 3 N m at a joint from t = 0.3 s on: r = 3 (1 - exp(-K t)), and nothing before."""
    data, dt = mujoco.MjData(model), EVERY * model.opt.timestep
    observer = MomentumObserver(ArmDynamics(model, JOINTS), dt, GAIN)
    torque, found, begins = np.array([4.0, -1.0]), [], round(0.3 / dt)
    for step in range(begins + 100):
        found.append(observer.update(data.qpos, data.qvel, torque))
        data.qfrc_applied[:] = torque
        data.qfrc_applied[pushed] += 3.0 if step >= begins else 0.0
        for _ in range(EVERY):
            mujoco.mj_step(model, data)
    residual = np.array(found)
    assert np.abs(data.qvel).max() > 0.5
    assert np.abs(residual[: begins + 1]).max() < 0.02
    wanted = np.zeros((100, 2))
    wanted[:, pushed] = 3.0 * (1.0 - (1.0 - GAIN * dt) ** np.arange(100))
    np.testing.assert_allclose(residual[begins:], wanted, atol=0.05)
    np.testing.assert_allclose(wanted[:, pushed], 3.0 * (1.0 - np.exp(-GAIN * dt * np.arange(100))), atol=0.06)


def test_after_a_reset_the_present_momentum_is_nobodys_push(model) -> None:
    observer = MomentumObserver(ArmDynamics(model, JOINTS), 0.01)
    observer.update(np.zeros(2), np.zeros(2), np.zeros(2))
    observer.reset()
    np.testing.assert_array_equal(observer.update(np.zeros(2), np.ones(2), np.zeros(2)), np.zeros(2))


@pytest.mark.parametrize("gain", [0.0, -1.0, 100.0])
def test_gains_that_cannot_be_are_refused(model, gain) -> None:
    with pytest.raises(InputError, match="above 0 and below 100/s"):
        MomentumObserver(ArmDynamics(model, JOINTS), 0.01, gain)


def test_a_joint_that_the_model_does_not_have_is_named(model) -> None:
    with pytest.raises(InputError, match="no joint 'wrist'"):
        ArmDynamics(model, ("shoulder", "wrist"))
