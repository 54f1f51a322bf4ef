"""One control step as a single compiled function.

robosuite computes the torques of every physics substep in Python, which takes most of a control step.
Here the loop

    repeat: torques of every arm's controller -> mj_step2 -> mj_step1

is compiled with numba and calls the libmujoco of the `mujoco` wheel through its C functions. It covers any
number of arms, each with a gripper or none, and these controllers (robosuite's `osc.py` and
`joint_*.py`; `M`, `bias` of the arm's own joints):

    OSC_POSE, OSC_POSITION   tau = J^T [L_p F; L_o T] + bias + N^T M (k_n (q_0 - q) - 2 sqrt(k_n) q')   k_n = 10
                             F = k_p (x_goal - x) - k_d v,   T = k_p e(R_goal, R) - k_d w   (v, w relative to the base)
                             L_p = (J_p M^-1 J_p^T)^-1,  L_o likewise,  N^T M a = M a - J^T (J M^-1 J^T)^-1 J a
    JOINT_POSITION           tau = M (k_p (q_goal - q) - k_d q') + bias
    JOINT_VELOCITY           tau = k_p e + k_i sum e + k_d mean of the last 5 changes of e + bias,   e = q'_goal - q'
    JOINT_TORQUE             tau = tau_goal + bias

(Khatib 1987, "A unified approach for motion and force control", eqs. 44-52 for the first.) robosuite forms
pseudo-inverses; here the same linear systems are solved by Cholesky factors. Where one is singular the substep
is left to robosuite.
"""

from pathlib import Path
from typing import Any

import llvmlite.binding
import mujoco
import numpy as np
from numba import njit, types

from lfd.worlds.step_records import CHANGES, JOINT_POSITION, JOINT_TORQUE, JOINT_VELOCITY, OSC, Physics

LIBRARY = next(Path(mujoco.__file__).parent.glob("libmujoco*"))
NULL_STIFFNESS = 10.0

llvmlite.binding.load_library_permanently(str(LIBRARY))

_address = types.intp
mj_step1 = types.ExternalFunction("mj_step1", types.void(_address, _address))
mj_step2 = types.ExternalFunction("mj_step2", types.void(_address, _address))
mj_jacSite = types.ExternalFunction(  # noqa: N816
    "mj_jacSite", types.void(_address, _address, _address, _address, types.int32)
)

compiled = njit(nogil=True, cache=True, error_model="numpy")
inlined = njit(nogil=True, cache=True, error_model="numpy", inline="always")


@compiled
def _factor(a: np.ndarray, n: int) -> bool:
    """Cholesky factor of a symmetric matrix in its lower triangle, the diagonal inverted.

    False when the matrix is not positive definite.
    """
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        if not pivot > 1e-14:
            return False
        a[j, j] = 1.0 / np.sqrt(pivot)
        for i in range(j + 1, n):
            entry = a[i, j]
            for k in range(j):
                entry -= a[i, k] * a[j, k]
            a[i, j] = entry * a[j, j]
    return True


@compiled
def _solve(factor: np.ndarray, b: np.ndarray, n: int, start: int) -> None:
    """Solve in place, for `n` numbers of `b` from `start` on, with what `_factor` made."""
    for i in range(n):
        value = b[start + i]
        for k in range(i):
            value -= factor[i, k] * b[start + k]
        b[start + i] = value * factor[i, i]
    for i in range(n - 1, -1, -1):
        value = b[start + i]
        for k in range(i + 1, n):
            value -= factor[k, i] * b[start + k]
        b[start + i] = value * factor[i, i]


@compiled
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


@inlined
def _present(p: Physics, arm: Any, m: Any) -> None:
    """Write what an arm's controller needs of the present state over the memory's arrays."""
    n = arm.joints
    for i in range(n):
        m.joint_pos[i], m.joint_vel[i] = p.qpos[arm.qpos[i]], p.qvel[arm.qvel[i]]
    kind = arm.kind
    if kind != JOINT_VELOCITY and kind != JOINT_TORQUE:
        for i in range(n):
            for j in range(n):
                at = arm.mass_at[i, j]
                m.mass[i, j] = p.qM[at] if at >= 0 else 0.0
    if kind == OSC:
        site = arm.site
        mj_jacSite(p.model, p.data, p.jac_pos.ctypes.data, p.jac_rot.ctypes.data, site)
        for i in range(3):
            m.position[i] = p.site_xpos[site, i]
            for j in range(3):
                m.rotation[i, j] = p.site_xmat[site, 3 * i + j]
        for i in range(6):
            m.velocity[i] = 0.0
        for k in range(n):
            column, speed = arm.qvel[k], m.joint_vel[k]
            for i in range(3):
                m.jacobian[k, i] = p.jac_pos[i, column]
                m.jacobian[k, 3 + i] = p.jac_rot[i, column]
            for i in range(6):
                m.velocity[i] += m.jacobian[k, i] * speed


@inlined
def _set_goal(p: Physics, arm: Any, m: Any, action: np.ndarray) -> None:
    """What an arm's part of an action asks for; an OSC goal is the present pose, moved, in the base's frame."""
    change = np.zeros(max(6, arm.width))
    for i in range(arm.width):
        bounded = min(max(action[arm.action_at + i], arm.input_low[i]), arm.input_high[i])
        change[i] = (bounded - arm.input_middle[i]) * arm.scale[i] + arm.output_middle[i]
    if arm.kind == OSC:
        turn = _rotation(change[3:6] if arm.turns else np.zeros(3))
        base = arm.base_site
        for i in range(3):
            m.goal_pos[i] = change[i]
            for j in range(3):
                m.goal_pos[i] += p.site_xmat[base, 3 * j + i] * (m.position[j] - p.site_xpos[base, j])
                m.goal_mat[i, j] = 0.0
                for k in range(3):
                    for c in range(3):
                        m.goal_mat[i, j] += turn[i, k] * p.site_xmat[base, 3 * c + k] * m.rotation[c, j]
    else:
        for i in range(arm.joints):
            goal = change[i] + (m.joint_pos[i] if arm.kind == JOINT_POSITION else 0.0)
            m.goal[i] = min(max(goal, arm.goal_low[i]), arm.goal_high[i])


@inlined
def _osc(p: Physics, arm: Any, m: Any, s: Any) -> bool:
    """Torques of operational space control, without the bias, in `s.tau`; False when a matrix is singular."""
    n, jac, mass, rotation, goal_mat = arm.joints, m.jacobian, m.mass, m.rotation, s.goal_mat
    base = arm.base_site
    for i in range(3):
        s.goal_pos[i] = p.site_xpos[base, i]
        for j in range(3):
            s.goal_pos[i] += p.site_xmat[base, 3 * i + j] * m.goal_pos[j]
            goal_mat[i, j] = 0.0
            for k in range(3):
                goal_mat[i, j] += p.site_xmat[base, 3 * i + k] * m.goal_mat[k, j]
    for i in range(6):
        s.speed[i] = m.velocity[i]
    if arm.base_moves:
        mj_jacSite(p.model, p.data, p.jac_pos.ctypes.data, p.jac_rot.ctypes.data, base)
        for k in range(n):
            column = arm.qvel[k]
            for i in range(3):
                s.speed[i] -= p.jac_pos[i, column] * p.qvel[column]
                s.speed[3 + i] -= p.jac_rot[i, column] * p.qvel[column]
    for i in range(3):  # e(R_goal, R) = 1/2 sum of the cross products of their columns
        j, k = (i + 1) % 3, (i + 2) % 3
        away = 0.0
        for c in range(3):
            away += 0.5 * (rotation[j, c] * goal_mat[k, c] - rotation[k, c] * goal_mat[j, c])
        s.wrench[i] = arm.kp[i] * (s.goal_pos[i] - m.position[i]) - arm.kd[i] * s.speed[i]
        s.wrench[3 + i] = arm.kp[3 + i] * away - arm.kd[3 + i] * s.speed[3 + i]

    for i in range(n):
        for j in range(i + 1):
            s.factor[i, j] = mass[i, j]
    if not _factor(s.factor, n):
        return False
    for k in range(n):  # spread = L^-1 J^T with M = L L^T
        for i in range(6):
            entry = jac[k, i]
            for j in range(k):
                entry -= s.factor[k, j] * s.spread[j, i]
            s.spread[k, i] = entry * s.factor[k, k]
    for i in range(6):  # J M^-1 J^T = spread^T spread, of which the lower triangle is enough
        for j in range(i + 1):
            entry = 0.0
            for k in range(n):
                entry += s.spread[k, i] * s.spread[k, j]
            s.inertia[i, j] = entry
    if arm.uncoupled:
        for start in (0, 3):
            for i in range(3):
                for j in range(i + 1):
                    s.block[i, j] = s.inertia[start + i, start + j]
            if not _factor(s.block, 3):
                return False
            _solve(s.block, s.wrench, 3, start)
        if not _factor(s.inertia, 6):
            return False
    else:
        if not _factor(s.inertia, 6):
            return False
        _solve(s.inertia, s.wrench, 6, 0)

    for i in range(6):
        s.lost[i] = 0.0
    for k in range(n):
        s.pull[k] = NULL_STIFFNESS * (m.rest[k] - m.joint_pos[k]) - 2 * np.sqrt(NULL_STIFFNESS) * m.joint_vel[k]
        for i in range(6):
            s.lost[i] += jac[k, i] * s.pull[k]
    _solve(s.inertia, s.lost, 6, 0)
    for k in range(n):
        tau = 0.0
        for i in range(6):
            tau += jac[k, i] * (s.wrench[i] - s.lost[i])
        for j in range(n):
            tau += mass[k, j] * s.pull[j]
        s.tau[k] = tau
    return True


@inlined
def _velocity_control(arm: Any, m: Any, s: Any) -> None:
    """Torques of JOINT_VELOCITY's PID controller, without the bias, in `s.tau`."""
    m.newest = (m.newest + 1) % CHANGES
    m.filled = min(m.filled + 1, CHANGES)
    for i in range(arm.joints):
        error = m.goal[i] - m.joint_vel[i]
        m.changes[m.newest, i] = error - m.last_error[i]
        m.last_error[i] = error
        if not m.saturated:
            m.error_sum[i] += error
        change = 0.0
        for k in range(m.filled):
            change += m.changes[k, i]
        change /= m.filled
        s.tau[i] = arm.kp[i] * error + arm.ki[i] * m.error_sum[i] + arm.kd[i] * change


@inlined
def _torques(p: Physics, arm: Any, m: Any, s: Any) -> bool:
    """Torques of an arm's controller, without the bias, in `s.tau`; False when a matrix is singular."""
    n, kind = arm.joints, arm.kind
    if kind == OSC:
        return _osc(p, arm, m, s)
    if kind == JOINT_VELOCITY:
        _velocity_control(arm, m, s)
    elif kind == JOINT_TORQUE:
        for i in range(n):
            s.tau[i] = m.goal[i]
    else:
        for i in range(n):
            s.pull[i] = arm.kp[i] * (m.goal[i] - m.joint_pos[i]) - arm.kd[i] * m.joint_vel[i]
        for i in range(n):
            s.tau[i] = 0.0
            for j in range(n):
                s.tau[i] += m.mass[i, j] * s.pull[j]
    return True


@inlined
def _close(p: Physics, gripper: Any, action: np.ndarray) -> None:
    """Move a gripper and write its controls, which do not change within a control step."""
    for i in range(gripper.fingers):
        moved = gripper.position[i] + gripper.step[i] * np.sign(action[gripper.action_at])
        gripper.position[i] = min(max(moved, -1.0), 1.0)
        p.ctrl[gripper.actuators[i]] = gripper.middle[i] + gripper.reach[i] * gripper.position[i]


@compiled
def control_step(
    p: Physics,
    arms: np.ndarray,
    grippers: np.ndarray,
    memory: np.ndarray,
    scratch: np.ndarray,
    action: np.ndarray,
    start: int,
    stop: int,
) -> int:
    """Advance the physics by the substeps `start` to `stop` of one control step; returns the first not taken.

    That is `stop`, unless a matrix is singular. `arms`, `grippers` and `memory` have one record for each arm,
    `scratch` one for all. Substep 0 sets the goals and moves the grippers. Positions and velocities in mjData are
    fresh (mj_step1) before and after.
    """
    s = scratch[0]
    if start == 0:
        for a in range(grippers.shape[0]):
            _close(p, grippers[a], action)
    for substep in range(start, stop):
        for a in range(arms.shape[0]):
            arm, m = arms[a], memory[a]
            if not m.stale:
                _present(p, arm, m)
            if substep == 0:
                _set_goal(p, arm, m, action)
            if not _torques(p, arm, m, s):
                return substep
            saturated = False
            for k in range(arm.joints):
                actuator, tau = arm.actuators[k], s.tau[k] + p.qfrc_bias[arm.qvel[k]]
                p.ctrl[actuator] = min(max(tau, arm.torque_low[k]), arm.torque_high[k])
                saturated |= p.ctrl[actuator] != tau
            m.saturated = saturated
        for a in range(arms.shape[0]):
            memory[a].stale = False
        mj_step2(p.model, p.data)
        mj_step1(p.model, p.data)
    return stop
