"""One control step as a single compiled function.

robosuite computes the torques of every physics substep in Python, which takes nine tenths of a control step.
Here the loop

    repeat: torques of the arm's controller -> mj_step2 -> mj_step1

is compiled with numba and calls the libmujoco of the `mujoco` wheel through its C functions. It covers
operational space control (OSC_POSE, OSC_POSITION) of one arm on a fixed base with a gripper.

    tau = J^T [L_p F; L_o T] + bias + N^T M (k_n (q_0 - q) - 2 sqrt(k_n) q')        k_n = 10
    F = k_p (x_goal - x) - k_d v,   T = k_p e(R_goal, R) - k_d w
    L_p = (J_p M^-1 J_p^T)^-1,  L_o likewise,  N^T M a = M a - J^T (J M^-1 J^T)^-1 J a

(Khatib 1987, "A unified approach for motion and force control", eqs. 44-52; robosuite's `osc.py`). robosuite
forms pseudo-inverses; here the same linear systems are solved by Cholesky factors. Where one is singular the
substep is left to robosuite.
"""

from pathlib import Path
from typing import NamedTuple

import llvmlite.binding
import mujoco
import numpy as np
from numba import njit, types

LIBRARY = next(Path(mujoco.__file__).parent.glob("libmujoco*"))
NULL_STIFFNESS = 10.0

llvmlite.binding.load_library_permanently(str(LIBRARY))

_address = types.intp
mj_step1 = types.ExternalFunction("mj_step1", types.void(_address, _address))
mj_step2 = types.ExternalFunction("mj_step2", types.void(_address, _address))
mj_fullM = types.ExternalFunction("mj_fullM", types.void(_address, _address, _address))  # noqa: N816
mj_jacSite = types.ExternalFunction(  # noqa: N816
    "mj_jacSite", types.void(_address, _address, _address, _address, types.int32)
)


class Physics(NamedTuple):
    """Addresses of mjModel and mjData and views into what mjData owns for its lifetime."""

    model: int
    data: int
    qM: int  # noqa: N815
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    qfrc_bias: np.ndarray
    site_xpos: np.ndarray
    site_xmat: np.ndarray
    jac_pos: np.ndarray
    jac_rot: np.ndarray
    mass: np.ndarray


class Arm(NamedTuple):
    """An arm's operational space controller, as robosuite configured it."""

    site: int
    qpos: np.ndarray
    qvel: np.ndarray
    actuators: np.ndarray
    torque_low: np.ndarray
    torque_high: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    input_low: np.ndarray
    input_high: np.ndarray
    scale: np.ndarray
    input_middle: np.ndarray
    output_middle: np.ndarray
    turns: bool
    """Whether the action turns the hand (OSC_POSE)."""
    uncoupled: bool
    base_pos: np.ndarray
    base_mat: np.ndarray


class Memory(NamedTuple):
    """What the controller keeps between control steps."""

    stale: bool
    """Whether the first substep takes the arrays below, as robosuite does after a reset."""
    rest: np.ndarray
    """Joint positions that the null space is drawn to [rad]."""
    joint_pos: np.ndarray
    joint_vel: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    jacobian: np.ndarray
    mass: np.ndarray


@njit(nogil=True, cache=True)
def _factor(a: np.ndarray) -> bool:
    """Cholesky factor of a symmetric matrix in its lower triangle; False when it is not positive definite."""
    n = a.shape[0]
    for j in range(n):
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        if not a[j, j] > 1e-14:
            return False
        a[j, j] = np.sqrt(a[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] /= a[j, j]
    return True


@njit(nogil=True, cache=True)
def _solve(factor: np.ndarray, b: np.ndarray) -> None:
    """Solve in place with a Cholesky factor."""
    n = factor.shape[0]
    for i in range(n):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]


@njit(nogil=True, cache=True)
def _rotation(turn: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector [rad], through a quaternion in single precision.

    robosuite rounds here; the same operations in the same precision keep the numbers equal.
    """
    angle = np.linalg.norm(turn)
    q = np.array([1.0, 0.0, 0.0, 0.0])
    if angle > 0.0:
        q[0] = np.cos(angle / 2.0)
        q[1:] = turn / angle * np.sin(angle / 2.0)
    single = q.astype(np.float32)
    single *= np.sqrt(2.0 / np.dot(single, single))
    p = np.outer(single, single)
    return np.array(
        [
            [1.0 - p[2, 2] - p[3, 3], p[1, 2] - p[3, 0], p[1, 3] + p[2, 0]],
            [p[1, 2] + p[3, 0], 1.0 - p[1, 1] - p[3, 3], p[2, 3] - p[1, 0]],
            [p[1, 3] - p[2, 0], p[2, 3] + p[1, 0], 1.0 - p[1, 1] - p[2, 2]],
        ]
    )


@njit(nogil=True, cache=True)
def _present(p: Physics, arm: Arm, m: Memory) -> None:
    """Write the arm's present pose, velocity, Jacobian and mass matrix over the memory's arrays."""
    mj_jacSite(p.model, p.data, p.jac_pos.ctypes.data, p.jac_rot.ctypes.data, arm.site)
    mj_fullM(p.model, p.mass.ctypes.data, p.qM)
    m.position[:] = p.site_xpos[arm.site]
    for i in range(3):
        m.velocity[i] = m.spin[i] = 0.0
        for j in range(3):
            m.rotation[i, j] = p.site_xmat[arm.site, 3 * i + j]
        for k in range(p.qvel.shape[0]):
            m.velocity[i] += p.jac_pos[i, k] * p.qvel[k]
            m.spin[i] += p.jac_rot[i, k] * p.qvel[k]
        for k in range(arm.qvel.shape[0]):
            m.jacobian[i, k] = p.jac_pos[i, arm.qvel[k]]
            m.jacobian[3 + i, k] = p.jac_rot[i, arm.qvel[k]]
    for i in range(arm.qvel.shape[0]):
        m.joint_pos[i], m.joint_vel[i] = p.qpos[arm.qpos[i]], p.qvel[arm.qvel[i]]
        for k in range(arm.qvel.shape[0]):
            m.mass[i, k] = p.mass[arm.qvel[i], arm.qvel[k]]


@njit(nogil=True, cache=True)
def _goal(arm: Arm, m: Memory, action: np.ndarray, goal_pos: np.ndarray, goal_mat: np.ndarray) -> None:
    """The world pose that an action asks for: the present one, moved in the frame of the base."""
    change = np.zeros(6)
    for i in range(6 if arm.turns else 3):
        bounded = min(max(action[i], arm.input_low[i]), arm.input_high[i])
        change[i] = (bounded - arm.input_middle[i]) * arm.scale[i] + arm.output_middle[i]
    turn, base = _rotation(change[3:]), arm.base_mat
    for i in range(3):
        goal_pos[i] = m.position[i]
        for j in range(3):
            goal_pos[i] += base[i, j] * change[j]
            goal_mat[i, j] = 0.0
            for k in range(3):
                for a in range(3):
                    for b in range(3):
                        goal_mat[i, j] += base[i, k] * turn[k, a] * base[b, a] * m.rotation[b, j]


@njit(nogil=True, cache=True)
def _torques(
    arm: Arm, m: Memory, goal_pos: np.ndarray, goal_mat: np.ndarray, bias: np.ndarray, tau: np.ndarray
) -> bool:
    """The controller's equation (see the module); False when a matrix is singular."""
    n, jac = arm.qvel.shape[0], m.jacobian
    wrench, away = np.zeros(6), np.zeros(3)
    for i in range(3):  # e(R_goal, R) = 1/2 sum of the cross products of their columns
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            away[i] += 0.5 * (m.rotation[j, c] * goal_mat[k, c] - m.rotation[k, c] * goal_mat[j, c])
    for i in range(3):
        wrench[i] = arm.kp[i] * (goal_pos[i] - m.position[i]) - arm.kd[i] * m.velocity[i]
        wrench[3 + i] = arm.kp[3 + i] * away[i] - arm.kd[3 + i] * m.spin[i]

    factor = m.mass.copy()
    if not _factor(factor):
        return False
    spread = np.empty((6, n))  # rows J_i M^-1
    for i in range(6):
        spread[i] = jac[i]
        _solve(factor, spread[i])
    inertia = np.zeros((6, 6))  # J M^-1 J^T
    for i in range(6):
        for j in range(6):
            for k in range(n):
                inertia[i, j] += spread[i, k] * jac[j, k]
    full = inertia.copy()
    if not _factor(full):
        return False
    if arm.uncoupled:
        for start in (0, 3):
            block = inertia[start : start + 3, start : start + 3].copy()
            if not _factor(block):
                return False
            _solve(block, wrench[start : start + 3])
    else:
        _solve(full, wrench)

    pull, lost = np.empty(n), np.zeros(6)
    for k in range(n):
        pull[k] = NULL_STIFFNESS * (m.rest[k] - m.joint_pos[k]) - 2 * np.sqrt(NULL_STIFFNESS) * m.joint_vel[k]
    for i in range(6):
        for k in range(n):
            lost[i] += jac[i, k] * pull[k]
    _solve(full, lost)
    for k in range(n):
        tau[k] = bias[arm.qvel[k]]
        for i in range(6):
            tau[k] += jac[i, k] * (wrench[i] - lost[i])
        for j in range(n):
            tau[k] += m.mass[k, j] * pull[j]
    return True


@njit(nogil=True, cache=True)
def control_step(
    p: Physics,
    arm: Arm,
    m: Memory,
    action: np.ndarray,
    goal_pos: np.ndarray,
    goal_mat: np.ndarray,
    start: int,
    stop: int,
) -> int:
    """Advance the physics by the substeps `start` to `stop` of one control step; returns the first not taken.

    That is `stop`, unless a matrix is singular. Substep 0 sets the goal, a pose in the world frame that later
    calls of the same control step hand in again. The gripper's controls stand in `p.ctrl` already: they do not
    change within a step. Positions and velocities in mjData are fresh (mj_step1) before and after.
    """
    tau = np.zeros(arm.qvel.shape[0])
    for substep in range(start, stop):
        if substep > 0 or not m.stale:
            _present(p, arm, m)
        if substep == 0:
            _goal(arm, m, action, goal_pos, goal_mat)
        if not _torques(arm, m, goal_pos, goal_mat, p.qfrc_bias, tau):
            return substep
        for k in range(tau.shape[0]):
            p.ctrl[arm.actuators[k]] = min(max(tau[k], arm.torque_low[k]), arm.torque_high[k])
        mj_step2(p.model, p.data)
        mj_step1(p.model, p.data)
    return stop
