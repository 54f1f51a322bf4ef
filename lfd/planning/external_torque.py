"""The torque with which somebody pushes an arm, from what the arm measures of itself: a generalised-momentum observer.

With M(q) qdd + C(q, qd) qd + g(q) = tau + d(q, qd) + tau_ext and the momentum p = M qd,

    dp/dt = tau + tau_ext + (dM/dt) qd - (C qd + g - d)
    r     = K_O (p(t) - p(0) - integral_0^t (tau + (dM/dt) qd - (C qd + g - d) + r) ds)      dr/dt = K_O (tau_ext - r)

so that r follows tau_ext as a first-order filter would, without accelerations (De Luca and Mattone 2003; De Luca, Albu-
Schaeffer, Haddadin and Hirzinger 2006). d are the model's damping and drag in air; dry friction is not modelled, and
stays in r. The model is one of the observer's own: nothing here looks at the simulation.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.core.errors import InputError

GAIN_1_S = 40.0
"""K_O; 1 / K_O is the time in which r has risen to 63% of a push."""
STEP_S = 1e-4
"""Of the difference quotient dM/dt ~ (M(q + qd h) - M(q - qd h)) / 2h."""


class ArmDynamics:
    """Mass matrix and bias of an arm's joints, by a MuJoCo model whose other joints stand still where they are."""

    def __init__(self, model: mujoco.MjModel, joints: Sequence[str], qpos: Float[np.ndarray, "nq"] | None = None):
        """`joints` are the names of the arm's joints; `qpos` is where all others are, the model's own without it."""
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in joints]
        if min(ids) < 0:
            raise InputError(f"the model has no joint {joints[int(np.argmin(ids))]!r}")
        self._model, self._data = model, mujoco.MjData(model)
        self._data.qpos[:] = model.qpos0 if qpos is None else qpos
        self._at, self._dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
        self._full = np.empty((model.nv, model.nv))

    def mass(self, q: Float[np.ndarray, "D"]) -> Float[np.ndarray, "D D"]:
        """M(q) [kg m^2]."""
        self._data.qpos[self._at] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_makeM(self._model, self._data)
        mujoco.mj_fullM(self._model, self._full, self._data.qM)
        return self._full[np.ix_(self._dofs, self._dofs)]

    def mass_and_bias(
        self, q: Float[np.ndarray, "D"], qd: Float[np.ndarray, "D"]
    ) -> tuple[Float[np.ndarray, "D D"], Float[np.ndarray, "D"]]:
        """M(q) [kg m^2] and C(q, qd) qd + g(q) - d(q, qd) [N m]."""
        mass = self.mass(q)
        self._data.qvel[:] = 0.0
        self._data.qvel[self._dofs] = qd
        mujoco.mj_comVel(self._model, self._data)
        mujoco.mj_passive(self._model, self._data)
        bias = np.empty(self._model.nv)
        mujoco.mj_rne(self._model, self._data, 0, bias)
        return mass, (bias - self._data.qfrc_passive)[self._dofs]

    def mass_rate(self, q: Float[np.ndarray, "D"], qd: Float[np.ndarray, "D"]) -> Float[np.ndarray, "D D"]:
        """dM/dt along qd [kg m^2/s]."""
        return (self.mass(q + STEP_S * qd) - self.mass(q - STEP_S * qd)) / (2 * STEP_S)


class MomentumObserver:
    """r of the equations above, from one measurement after the other."""

    def __init__(self, dynamics: ArmDynamics, dt_s: float, gain: float = GAIN_1_S):
        """`dt_s` is the time between measurements [s], `gain` K_O [1/s].

        Raises `InputError` for a gain that is not positive or too large for these measurements.
        """
        if not 0.0 < gain * dt_s < 1.0:
            raise InputError(
                f"gain = {gain}/s with measurements every {dt_s} s: must be above 0 and below {1 / dt_s:g}/s"
            )
        self._dynamics, self._dt_s, self._gain = dynamics, dt_s, gain
        self._momentum: np.ndarray | None = None

    def reset(self) -> None:
        """Begin anew: whatever comes next is taken for a state in which nobody pushes."""
        self._momentum = None

    def update(
        self, q: Float[np.ndarray, "D"], qd: Float[np.ndarray, "D"], torque: Float[np.ndarray, "D"]
    ) -> Float[np.ndarray, "D"]:
        """r after a measurement [N m]; `torque` acted since the one before, gravity included [N m]."""
        mass, bias = self._dynamics.mass_and_bias(q, qd)
        momentum = mass @ qd
        moved = torque + self._dynamics.mass_rate(q, qd) @ qd - bias
        if self._momentum is None:
            self._integral, self._residual = momentum, np.zeros(len(q))
        else:
            self._integral = self._integral + self._dt_s * (0.5 * (moved + self._moved) + self._residual)
            self._residual = self._gain * (momentum - self._integral)
        self._momentum, self._moved = momentum, moved
        return self._residual
