"""One control step as a single compiled function.

robosuite computes the torques of every physics substep in Python, which takes nine tenths of a control step.
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
from typing import NamedTuple

import llvmlite.binding
import mujoco
import numpy as np
from numba import njit, types

LIBRARY = next(Path(mujoco.__file__).parent.glob("libmujoco*"))
NULL_STIFFNESS = 10.0
OSC, JOINT_POSITION, JOINT_VELOCITY, JOINT_TORQUE = range(4)
"""Kinds of controllers, as `Arms.kind` has them."""
CHANGES = 5
"""Length of JOINT_VELOCITY's buffer of changes of the error."""

llvmlite.binding.load_library_permanently(str(LIBRARY))

_address = types.intp
mj_step1 = types.ExternalFunction("mj_step1", types.void(_address, _address))
mj_step2 = types.ExternalFunction("mj_step2", types.void(_address, _address))
mj_jacSite = types.ExternalFunction(  # noqa: N816
    "mj_jacSite", types.void(_address, _address, _address, _address, types.int32)
)

compiled = njit(nogil=True, cache=True, error_model="numpy")
inlined = njit(nogil=True, cache=True, error_model="numpy", inline="always")


class Physics(NamedTuple):
    """Addresses of mjModel and mjData and views into what mjData owns for its lifetime."""

    model: int
    data: int
    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    qM: np.ndarray  # noqa: N815
    qfrc_bias: np.ndarray
    site_xpos: np.ndarray
    site_xmat: np.ndarray


class Arms(NamedTuple):
    """The arms and their controllers as robosuite configured them.

    The first axis of every array is the arm. A second axis is its joint (n), or the component of its action
    or of its gains (w); what an arm does not have is never read.
    """

    kind: np.ndarray
    joints: np.ndarray
    """Number of joints of each arm."""
    site: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    actuators: np.ndarray
    torque_low: np.ndarray
    torque_high: np.ndarray
    mass_at: np.ndarray
    """Where the entries of the arm's mass matrix stand in mjData's sparse one, (arms, n, n); -1 for a zero."""
    kp: np.ndarray
    kd: np.ndarray
    ki: np.ndarray
    action_at: np.ndarray
    """Where the arm's part of the action begins, and how long it is."""
    width: np.ndarray
    input_low: np.ndarray
    input_high: np.ndarray
    scale: np.ndarray
    input_middle: np.ndarray
    output_middle: np.ndarray
    goal_low: np.ndarray
    """Limits of the scaled goal of the joint controllers: velocities, torques or positions."""
    goal_high: np.ndarray
    turns: np.ndarray
    """Whether the action turns the hand (OSC_POSE)."""
    uncoupled: np.ndarray
    base_site: np.ndarray
    """Site of the frame in which the action moves the hand, and whether that frame moves (an IIWA's turns with
    its first joint)."""
    base_moves: np.ndarray


class Grippers(NamedTuple):
    """The grippers: each control step moves a gripper's position by `step` along the sign of its action.

    A position of -1 to 1 is mapped linearly onto the range of the actuator's control.
    """

    action_at: np.ndarray
    actuators: np.ndarray
    """(grippers, fingers), -1 where a gripper has fewer fingers."""
    step: np.ndarray
    middle: np.ndarray
    reach: np.ndarray
    position: np.ndarray


class Memory(NamedTuple):
    """What the controllers keep between control steps, and what they have computed of the present state."""

    stale: np.ndarray
    """Whether the first substep takes the arrays below as they are, as robosuite does after a reset."""
    rest: np.ndarray
    """Joint positions that the null space is drawn to [rad]."""
    joint_pos: np.ndarray
    joint_vel: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    """Linear and angular velocity of the hand, (arms, 6)."""
    jacobian: np.ndarray
    """Transposed, (arms, n, 6)."""
    mass: np.ndarray
    goal_pos: np.ndarray
    """Goal of OSC in the frame of the base: position, and rotation matrix."""
    goal_mat: np.ndarray
    goal: np.ndarray
    """Goal of the joint controllers, (arms, n)."""
    last_error: np.ndarray
    error_sum: np.ndarray
    changes: np.ndarray
    """Ring buffer of the changes of the error, (arms, 5, n); where it was last written; how many it holds."""
    newest: np.ndarray
    filled: np.ndarray
    saturated: np.ndarray


class Scratch(NamedTuple):
    """Room for intermediate results."""

    jac_pos: np.ndarray
    jac_rot: np.ndarray
    factor: np.ndarray
    spread: np.ndarray
    inertia: np.ndarray
    block: np.ndarray
    tau: np.ndarray
    pull: np.ndarray
    wrench: np.ndarray
    lost: np.ndarray
    speed: np.ndarray
    goal_pos: np.ndarray
    goal_mat: np.ndarray


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
def _present(p: Physics, arms: Arms, a: int, m: Memory, s: Scratch) -> None:
    """Write what arm `a`'s controller needs of the present state over the memory's arrays."""
    n = arms.joints[a]
    for i in range(n):
        m.joint_pos[a, i], m.joint_vel[a, i] = p.qpos[arms.qpos[a, i]], p.qvel[arms.qvel[a, i]]
    kind = arms.kind[a]
    if kind != JOINT_VELOCITY and kind != JOINT_TORQUE:
        for i in range(n):
            for j in range(n):
                at = arms.mass_at[a, i, j]
                m.mass[a, i, j] = p.qM[at] if at >= 0 else 0.0
    if kind == OSC:
        site = arms.site[a]
        mj_jacSite(p.model, p.data, s.jac_pos.ctypes.data, s.jac_rot.ctypes.data, site)
        for i in range(3):
            m.position[a, i] = p.site_xpos[site, i]
            for j in range(3):
                m.rotation[a, i, j] = p.site_xmat[site, 3 * i + j]
        for i in range(6):
            m.velocity[a, i] = 0.0
        for k in range(n):
            column, speed = arms.qvel[a, k], m.joint_vel[a, k]
            for i in range(3):
                m.jacobian[a, k, i] = s.jac_pos[i, column]
                m.jacobian[a, k, 3 + i] = s.jac_rot[i, column]
            for i in range(6):
                m.velocity[a, i] += m.jacobian[a, k, i] * speed


@inlined
def _set_goal(p: Physics, arms: Arms, a: int, m: Memory, action: np.ndarray) -> None:
    """What arm `a`'s part of an action asks for; an OSC goal is the present pose, moved, in the base's frame."""
    change = np.zeros(max(6, arms.width[a]))
    for i in range(arms.width[a]):
        bounded = min(max(action[arms.action_at[a] + i], arms.input_low[a, i]), arms.input_high[a, i])
        change[i] = (bounded - arms.input_middle[a, i]) * arms.scale[a, i] + arms.output_middle[a, i]
    if arms.kind[a] == OSC:
        turn = _rotation(change[3:6] if arms.turns[a] else np.zeros(3))
        base = arms.base_site[a]
        for i in range(3):
            m.goal_pos[a, i] = change[i]
            for j in range(3):
                m.goal_pos[a, i] += p.site_xmat[base, 3 * j + i] * (m.position[a, j] - p.site_xpos[base, j])
                m.goal_mat[a, i, j] = 0.0
                for k in range(3):
                    for c in range(3):
                        m.goal_mat[a, i, j] += turn[i, k] * p.site_xmat[base, 3 * c + k] * m.rotation[a, c, j]
    else:
        for i in range(arms.joints[a]):
            goal = change[i] + (m.joint_pos[a, i] if arms.kind[a] == JOINT_POSITION else 0.0)
            m.goal[a, i] = min(max(goal, arms.goal_low[a, i]), arms.goal_high[a, i])


@inlined
def _osc(p: Physics, arms: Arms, a: int, m: Memory, s: Scratch) -> bool:
    """Torques of operational space control, without the bias, in `s.tau`; False when a matrix is singular."""
    n, jac, mass, rotation, goal_mat = arms.joints[a], m.jacobian[a], m.mass[a], m.rotation[a], s.goal_mat
    base = arms.base_site[a]
    for i in range(3):
        s.goal_pos[i] = p.site_xpos[base, i]
        for j in range(3):
            s.goal_pos[i] += p.site_xmat[base, 3 * i + j] * m.goal_pos[a, j]
            goal_mat[i, j] = 0.0
            for k in range(3):
                goal_mat[i, j] += p.site_xmat[base, 3 * i + k] * m.goal_mat[a, k, j]
    for i in range(6):
        s.speed[i] = m.velocity[a, i]
    if arms.base_moves[a]:
        mj_jacSite(p.model, p.data, s.jac_pos.ctypes.data, s.jac_rot.ctypes.data, base)
        for k in range(n):
            column = arms.qvel[a, k]
            for i in range(3):
                s.speed[i] -= s.jac_pos[i, column] * p.qvel[column]
                s.speed[3 + i] -= s.jac_rot[i, column] * p.qvel[column]
    for i in range(3):  # e(R_goal, R) = 1/2 sum of the cross products of their columns
        j, k = (i + 1) % 3, (i + 2) % 3
        away = 0.0
        for c in range(3):
            away += 0.5 * (rotation[j, c] * goal_mat[k, c] - rotation[k, c] * goal_mat[j, c])
        s.wrench[i] = arms.kp[a, i] * (s.goal_pos[i] - m.position[a, i]) - arms.kd[a, i] * s.speed[i]
        s.wrench[3 + i] = arms.kp[a, 3 + i] * away - arms.kd[a, 3 + i] * s.speed[3 + i]

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
    if arms.uncoupled[a]:
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
        s.pull[k] = (
            NULL_STIFFNESS * (m.rest[a, k] - m.joint_pos[a, k]) - 2 * np.sqrt(NULL_STIFFNESS) * m.joint_vel[a, k]
        )
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
def _velocity_control(arms: Arms, a: int, m: Memory, s: Scratch) -> None:
    """Torques of JOINT_VELOCITY's PID controller, without the bias, in `s.tau`."""
    m.newest[a] = (m.newest[a] + 1) % CHANGES
    m.filled[a] = min(m.filled[a] + 1, CHANGES)
    for i in range(arms.joints[a]):
        error = m.goal[a, i] - m.joint_vel[a, i]
        m.changes[a, m.newest[a], i] = error - m.last_error[a, i]
        m.last_error[a, i] = error
        if not m.saturated[a]:
            m.error_sum[a, i] += error
        change = 0.0
        for k in range(m.filled[a]):
            change += m.changes[a, k, i]
        change /= m.filled[a]
        s.tau[i] = arms.kp[a, i] * error + arms.ki[a, i] * m.error_sum[a, i] + arms.kd[a, i] * change


@inlined
def _torques(p: Physics, arms: Arms, a: int, m: Memory, s: Scratch) -> bool:
    """Torques of arm `a`'s controller, without the bias, in `s.tau`; False when a matrix is singular."""
    n, kind = arms.joints[a], arms.kind[a]
    if kind == OSC:
        return _osc(p, arms, a, m, s)
    if kind == JOINT_VELOCITY:
        _velocity_control(arms, a, m, s)
    elif kind == JOINT_TORQUE:
        for i in range(n):
            s.tau[i] = m.goal[a, i]
    else:
        for i in range(n):
            s.pull[i] = arms.kp[a, i] * (m.goal[a, i] - m.joint_pos[a, i]) - arms.kd[a, i] * m.joint_vel[a, i]
        for i in range(n):
            s.tau[i] = 0.0
            for j in range(n):
                s.tau[i] += m.mass[a, i, j] * s.pull[j]
    return True


@inlined
def _close(p: Physics, grippers: Grippers, action: np.ndarray) -> None:
    """Move the grippers' positions and write their controls, which do not change within a control step."""
    for g in range(grippers.action_at.shape[0]):
        for i in range(grippers.actuators.shape[1]):
            if grippers.actuators[g, i] >= 0:
                moved = grippers.position[g, i] + grippers.step[g, i] * np.sign(action[grippers.action_at[g]])
                grippers.position[g, i] = min(max(moved, -1.0), 1.0)
                p.ctrl[grippers.actuators[g, i]] = (
                    grippers.middle[g, i] + grippers.reach[g, i] * grippers.position[g, i]
                )


@compiled
def control_step(
    p: Physics, arms: Arms, grippers: Grippers, m: Memory, s: Scratch, action: np.ndarray, start: int, stop: int
) -> int:
    """Advance the physics by the substeps `start` to `stop` of one control step; returns the first not taken.

    That is `stop`, unless a matrix is singular. Substep 0 sets the goals and moves the grippers. Positions and
    velocities in mjData are fresh (mj_step1) before and after.
    """
    if start == 0:
        _close(p, grippers, action)
    for substep in range(start, stop):
        for a in range(arms.kind.shape[0]):
            if not m.stale[a]:
                _present(p, arms, a, m, s)
            if substep == 0:
                _set_goal(p, arms, a, m, action)
            if not _torques(p, arms, a, m, s):
                return substep
            saturated = False
            for k in range(arms.joints[a]):
                actuator, tau = arms.actuators[a, k], s.tau[k] + p.qfrc_bias[arms.qvel[a, k]]
                p.ctrl[actuator] = min(max(tau, arms.torque_low[a, k]), arms.torque_high[a, k])
                saturated |= p.ctrl[actuator] != tau
            m.saturated[a] = saturated
        for a in range(arms.kind.shape[0]):
            m.stale[a] = False
        mj_step2(p.model, p.data)
        mj_step1(p.model, p.data)
    return stop
