"""What computes a control step of a robosuite environment: robosuite itself, or the compiled function."""

from typing import Any, Protocol

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.core.errors import SimulationError, UnknownName

MUJOCO = "3.3.7"
"""The version whose C functions the compiled step calls; another one's signatures could crash the process."""


class Stepper(Protocol):
    """Advances an environment's physics by one control step; mjData is fresh (mj_step1) before and after."""

    name: str

    def step(self, action: Float[np.ndarray, "Da"]) -> None: ...


class RobosuiteStepper:
    """robosuite's own step."""

    name = "robosuite"

    def __init__(self, env: Any):
        self._env = env

    def step(self, action: Float[np.ndarray, "Da"]) -> None:
        self._env.step(action)
        mujoco.mj_step1(self._env.sim.model._model, self._env.sim.data._data)


class CompiledStepper:
    """The compiled step (`lfd.worlds.compiled_step`), bound to an environment's present model.

    Raises `SimulationError` for a robot or controller that it does not cover.
    """

    name = "compiled"

    def __init__(self, env: Any):
        from lfd.worlds import compiled_step as c

        reason = uncovered(env)
        if reason:
            raise SimulationError(f"the compiled step does not cover {reason}")
        self._env, self._robot = env, env.robots[0]
        model, data = env.sim.model._model, env.sim.data._data
        self._gripper_actuators = np.array(self._robot._ref_actuators_indexes_dict["right_gripper"])
        low, high = model.actuator_ctrlrange[self._gripper_actuators].T
        self._gripper_middle, self._gripper_reach = 0.5 * (high + low), 0.5 * (high - low)
        part, nv = self._part, model.nv
        self._control_step = c.control_step
        self._physics = c.Physics(
            model=model._address,
            data=data._address,
            qM=data.qM.ctypes.data,
            qpos=data.qpos,
            qvel=data.qvel,
            ctrl=data.ctrl,
            qfrc_bias=data.qfrc_bias,
            site_xpos=data.site_xpos,
            site_xmat=data.site_xmat,
            jac_pos=np.empty((3, nv)),
            jac_rot=np.empty((3, nv)),
            mass=np.empty((nv, nv)),
        )
        part.scale_action(np.zeros(part.control_dim))  # fills in its scale
        actuators = np.array(self._robot._ref_actuators_indexes_dict["right"])
        self._arm = c.Arm(
            site=env.sim.model.site_name2id(part.ref_name),
            qpos=np.array(part.qpos_index),
            qvel=np.array(part.qvel_index),
            actuators=actuators,
            torque_low=model.actuator_ctrlrange[actuators, 0].copy(),
            torque_high=model.actuator_ctrlrange[actuators, 1].copy(),
            kp=np.array(part.kp, dtype=float),
            kd=np.array(part.kd, dtype=float),
            input_low=np.array(part.input_min, dtype=float),
            input_high=np.array(part.input_max, dtype=float),
            scale=np.array(part.action_scale, dtype=float),
            input_middle=np.array(part.action_input_transform, dtype=float),
            output_middle=np.array(part.action_output_transform, dtype=float),
            turns=bool(part.use_ori),
            uncoupled=bool(part.uncoupling),
            base_pos=np.array(part.origin_pos),
            base_mat=np.array(part.origin_ori),
        )
        self._memory_class = c.Memory
        self._substeps = int(env.control_timestep / env.model_timestep)
        self._goal = np.empty(3), np.empty((3, 3))

    @property
    def _part(self) -> Any:
        return self._robot.composite_controller.part_controllers["right"]

    def step(self, action: Float[np.ndarray, "Da"]) -> None:
        arm_size = self._part.control_dim
        self._close(action[arm_size:])
        memory = self._memory()
        at = 0
        while at < self._substeps:
            at = self._control_step(self._physics, self._arm, memory, action, *self._goal, at, self._substeps)
            if at < self._substeps:
                self._robosuite_substep()
                at += 1
        for part in self._robot.composite_controller.part_controllers.values():
            part.new_update = True  # what the controllers remember of the state is of an earlier one

    def _close(self, action: np.ndarray) -> None:
        """The gripper's controls, as robosuite's grip controller computes them once a control step.

        It maps the gripper's own action, -1 to 1 for each finger, linearly onto the actuators' range.
        """
        fingers = self._robot.gripper["right"].format_action(action)
        goal = np.minimum(np.maximum(fingers, -1.0), 1.0)
        self._physics.ctrl[self._gripper_actuators] = self._gripper_middle + self._gripper_reach * goal

    def _memory(self) -> Any:
        """The controller's memory as the compiled function wants it.

        Copies: the function writes the present state over them, and robosuite's arrays share memory with each
        other (the null space's target with the joint positions, for one).
        """
        part = self._part
        return self._memory_class(
            stale=not part.new_update,
            rest=np.array(part.initial_joint),
            joint_pos=np.array(part.joint_pos),
            joint_vel=np.array(part.joint_vel),
            position=np.array(part.ref_pos),
            rotation=np.array(part.ref_ori_mat),
            velocity=np.array(part.ref_pos_vel),
            spin=np.array(part.ref_ori_vel),
            jacobian=np.array(part.J_full),
            mass=np.array(part.mass_matrix, order="C"),
        )

    def _robosuite_substep(self) -> None:
        """One substep by robosuite's controller, towards the goal of this control step."""
        goal_pos, goal_mat = self._goal
        part, base_mat = self._part, self._arm.base_mat
        part.goal_pos, part.goal_ori = base_mat.T @ (goal_pos - self._arm.base_pos), base_mat.T @ goal_mat
        part.new_update = True
        low, high = self._arm.torque_low, self._arm.torque_high
        self._physics.ctrl[self._arm.actuators] = np.clip(part.run_controller(), low, high)
        model, data = self._env.sim.model._model, self._env.sim.data._data
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)


def uncovered(env: Any) -> str:
    """What of an environment the compiled step does not cover; empty when it covers everything."""
    if mujoco.__version__ != MUJOCO:
        return f"mujoco {mujoco.__version__}, only {MUJOCO}"
    if len(env.robots) != 1 or list(env.robots[0].arms) != ["right"]:
        return "more than one arm"
    if not env.lite_physics:
        return "lite_physics=False"
    parts = env.robots[0].composite_controller.part_controllers
    if set(parts) != {"right", "right_gripper"}:
        return f"the parts {', '.join(parts)}"
    part = parts["right"]
    if part.name not in ("OSC_POSE", "OSC_POSITION"):
        return f"the controller {part.name}"
    if (part.impedance_mode, part.input_type, part.input_ref_frame) != ("fixed", "delta", "base"):
        return f"impedance {part.impedance_mode}, input {part.input_type}, frame {part.input_ref_frame}"
    if part.interpolator_pos is not None or part.interpolator_ori is not None:
        return "interpolators"
    grip = parts["right_gripper"]
    plain = {grip.input_max.max(), grip.output_max.max()} == {1.0} == {-grip.input_min.min(), -grip.output_min.min()}
    simple = type(grip).__name__ == "SimpleGripController"
    if not (simple and grip.use_action_scaling and grip.interpolator is None and plain):
        return f"the gripper controller {type(grip).__name__} as it is configured"
    return ""


STEPPERS = {"robosuite": RobosuiteStepper, "compiled": CompiledStepper}
"""Steppers by the name that recordings keep."""


def make_stepper(name: str, env: Any) -> Stepper:
    """The stepper called `name`, bound to the environment's present model; `auto` takes the fastest that fits.

    Raises `UnknownName`, and `SimulationError` for a stepper that does not cover the environment.
    """
    if name == "auto":
        name = "robosuite" if uncovered(env) else "compiled"
    if name not in STEPPERS:
        raise UnknownName("stepper", name, (*STEPPERS, "auto"))
    return STEPPERS[name](env)
