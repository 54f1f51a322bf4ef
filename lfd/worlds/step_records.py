"""What the compiled step (`lfd.worlds.compiled_step`) works on: records of fixed size, one for each arm.

One compilation then serves every robot, and handing them over costs little. Free of numba, whose
cache on disk does not notice when a constant here changes: change `compiled_step.py` in the same commit.
"""

from typing import NamedTuple

import numpy as np

OSC, JOINT_POSITION, JOINT_VELOCITY, JOINT_TORQUE = range(4)
"""Kinds of controllers, as ARM's `kind` has them."""
JOINTS = 8
"""Most joints of an arm, and most components of its action, that there is room for."""
CHANGES = 5
"""Length of JOINT_VELOCITY's buffer of changes of the error."""


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
    jac_pos: np.ndarray
    """Room for a site's Jacobians, (3, nv)."""
    jac_rot: np.ndarray


def _record(**fields: object) -> np.dtype:
    """A structured type: each field's type, or its type and shape."""
    return np.dtype(
        [(name, *(kind if isinstance(kind, tuple) else (kind,))) for name, kind in fields.items()], align=True
    )


_vector, _indices = (np.float64, (JOINTS,)), (np.int64, (JOINTS,))
_square, _place, _turn = (np.float64, (JOINTS, JOINTS)), (np.float64, (3,)), (np.float64, (3, 3))

ARM = _record(
    kind=np.int64,
    joints=np.int64,  # number of joints, n; what lies beyond n in the arrays below is never read
    site=np.int64,
    qpos=_indices,
    qvel=_indices,
    actuators=_indices,
    torque_low=_vector,
    torque_high=_vector,
    mass_at=(np.int64, (JOINTS, JOINTS)),  # where the mass matrix stands in mjData's sparse one; -1 for a zero
    kp=_vector,
    kd=_vector,
    ki=_vector,
    action_at=np.int64,  # where the arm's part of the action begins, and how long it is
    width=np.int64,
    input_low=_vector,
    input_high=_vector,
    scale=_vector,
    input_middle=_vector,
    output_middle=_vector,
    goal_low=_vector,  # limits of the scaled goal of the joint controllers: velocities, torques or positions
    goal_high=_vector,
    turns=np.bool_,  # whether the action turns the hand (OSC_POSE)
    uncoupled=np.bool_,
    base_site=np.int64,  # site of the frame in which the action moves the hand
    base_moves=np.bool_,  # an IIWA's turns with its first joint
)
"""An arm and its controller as robosuite configured them."""

GRIPPER = _record(
    action_at=np.int64,
    fingers=np.int64,
    actuators=_indices,
    step=_vector,  # each control step moves the position by this along the sign of the action, within -1 to 1
    middle=_vector,  # the actuator's control is middle + reach * position
    reach=_vector,
    position=_vector,
)
"""A gripper; without fingers where an arm has none."""

MEMORY = _record(
    stale=np.bool_,  # whether the first substep takes what follows as it is, as robosuite does after a reset
    rest=_vector,  # joint positions that the null space is drawn to [rad]
    joint_pos=_vector,
    joint_vel=_vector,
    position=_place,
    rotation=_turn,
    velocity=(np.float64, (6,)),  # of the hand, linear and angular
    jacobian=(np.float64, (JOINTS, 6)),  # transposed
    mass=_square,
    goal_pos=_place,  # goal of OSC in the frame of the base: position, and rotation matrix
    goal_mat=_turn,
    goal=_vector,  # goal of the joint controllers
    last_error=_vector,  # JOINT_VELOCITY's filter
    error_sum=_vector,
    changes=(np.float64, (CHANGES, JOINTS)),  # ring buffer of the changes of the error
    newest=np.int64,  # where it was last written, and how many it holds
    filled=np.int64,
    saturated=np.bool_,
)
"""What an arm's controller keeps between control steps, and what it has computed of the present state."""

SCRATCH = _record(
    factor=_square,
    spread=(np.float64, (JOINTS, 6)),
    inertia=(np.float64, (6, 6)),
    block=_turn,
    tau=_vector,
    pull=_vector,
    wrench=(np.float64, (6,)),
    lost=(np.float64, (6,)),
    speed=(np.float64, (6,)),
    goal_pos=_place,
    goal_mat=_turn,
)
"""Room for intermediate results."""
