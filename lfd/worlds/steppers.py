"""What computes a control step of a robosuite environment: robosuite itself, or the compiled function."""

from collections.abc import Iterator
from typing import Any, Protocol

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.core.errors import SimulationError, UnknownName
from lfd.worlds import step_records as records

MUJOCO = "3.3.7"
"""The version whose C functions the compiled step calls; another one's signatures could crash the process."""
OSC_NAMES = ("OSC_POSE", "OSC_POSITION")
JOINT_NAMES = ("JOINT_POSITION", "JOINT_VELOCITY", "JOINT_TORQUE")


class Stepper(Protocol):
    """Advances an environment's physics by one control step; mjData is fresh (mj_step1) before and after.

    What the controllers remember may live in the stepper while it steps: `store` writes it into robosuite's
    objects, `load` takes it from there.
    """

    name: str

    def step(self, action: Float[np.ndarray, "Da"]) -> None: ...

    def load(self) -> None: ...

    def store(self) -> None: ...


class RobosuiteStepper:
    """robosuite's own step, without its observables and its reward."""

    name = "robosuite"

    def __init__(self, env: Any):
        self._env = env

    def step(self, action: Float[np.ndarray, "Da"]) -> None:
        env, sim = self._env, self._env.sim
        for substep in range(int(env.control_timestep / env.model_timestep)):
            if env.lite_physics:
                sim.step1()
                env._pre_action(action, substep == 0)
                sim.step2()
            else:
                sim.forward()
                env._pre_action(action, substep == 0)
                sim.step()
        mujoco.mj_step1(sim.model._model, sim.data._data)

    def load(self) -> None:
        """robosuite's objects are the memory."""

    def store(self) -> None:
        """robosuite's objects are the memory."""


class CompiledStepper:
    """The compiled step (`lfd.worlds.compiled_step`), bound to an environment's present model.

    Raises `SimulationError` for a robot or controller that it does not cover.
    """

    name = "compiled"

    def __init__(self, env: Any):
        from lfd.worlds.compiled_step import control_step  # loads the compiler

        reason = uncovered(env)
        if reason:
            raise SimulationError(f"the compiled step does not cover {reason}")
        self._env, self._control_step = env, control_step
        model, data = env.sim.model._model, env.sim.data._data
        self._physics = records.Physics(
            model=model._address,
            data=data._address,
            jac_pos=np.zeros((3, model.nv)),
            jac_rot=np.zeros((3, model.nv)),
            **{name: getattr(data, name) for name in records.Physics._fields[2:-2]},
        )
        arms = list(arms_of(env))
        self._arms = _records(records.ARM, [_arm(env, robot, arm) for robot, arm in arms])
        self._grippers = _records(records.GRIPPER, [_gripper(env, robot, arm) for robot, arm in arms])
        self._memory, self._scratch = np.zeros(len(arms), records.MEMORY), np.zeros(1, records.SCRATCH)
        self._substeps = int(env.control_timestep / env.model_timestep)
        self.load()

    def step(self, action: Float[np.ndarray, "Da"]) -> None:
        at = 0
        while at < self._substeps:
            at = self._control_step(
                self._physics, self._arms, self._grippers, self._memory, self._scratch, action, at, self._substeps
            )
            if at < self._substeps:
                self._robosuite_substep()
                at += 1

    def load(self) -> None:
        for (robot, arm), m, held in zip(arms_of(self._env), self._memory, self._grippers, strict=True):
            part, gripper = robot.composite_controller.part_controllers[arm], robot.gripper[arm]
            n = part.joint_dim
            m["stale"] = not part.new_update
            m["joint_pos"][:n], m["joint_vel"][:n] = part.joint_pos, part.joint_vel
            m["mass"][:n, :n] = part.mass_matrix
            if part.name in OSC_NAMES:
                m["rest"][:n] = part.initial_joint
                m["position"], m["rotation"] = part.ref_pos, part.ref_ori_mat
                m["velocity"] = *part.ref_pos_vel, *part.ref_ori_vel
                m["jacobian"][:n] = part.J_full.T
            if part.name == "JOINT_VELOCITY":
                m["last_error"][:n], m["error_sum"][:n] = part.last_err, part.summed_err
                m["changes"][:, :n] = part.derr_buf.buf
                m["newest"], m["filled"], m["saturated"] = part.derr_buf.ptr, part.derr_buf._size, part.saturated
            held["position"][: held["fingers"]] = gripper.current_action if gripper.dof else 0.0

    def store(self) -> None:
        for (robot, arm), m, held in zip(arms_of(self._env), self._memory, self._grippers, strict=True):
            part, gripper = robot.composite_controller.part_controllers[arm], robot.gripper[arm]
            n = part.joint_dim
            if not m["stale"]:
                part.new_update = True
            if part.name == "JOINT_VELOCITY":
                part.last_err, part.summed_err = m["last_error"][:n].copy(), m["error_sum"][:n].copy()
                part.derr_buf.buf = m["changes"][:, :n].copy()
                part.derr_buf.ptr, part.derr_buf._size = int(m["newest"]), int(m["filled"])
                part.saturated = bool(m["saturated"])
            if gripper.dof:
                gripper.current_action = held["position"][: held["fingers"]].copy()

    def _robosuite_substep(self) -> None:
        """One substep by robosuite's controllers, towards the goals of this control step."""
        self.store()
        goals = {"JOINT_POSITION": "goal_qpos", "JOINT_VELOCITY": "goal_vel", "JOINT_TORQUE": "goal_torque"}
        for (robot, arm), known, m in zip(arms_of(self._env), self._arms, self._memory, strict=True):
            part = robot.composite_controller.part_controllers[arm]
            n = part.joint_dim
            part.new_update = True
            if part.name in OSC_NAMES:
                part.update_origin(*robot.composite_controller.get_controller_base_pose(arm))
                part.goal_pos, part.goal_ori = m["goal_pos"].copy(), m["goal_mat"].copy()
            else:
                setattr(part, goals[part.name], m["goal"][:n].copy())
            torques = np.clip(part.run_controller(), known["torque_low"][:n], known["torque_high"][:n])
            self._physics.ctrl[known["actuators"][:n]] = torques
        model, data = self._env.sim.model._model, self._env.sim.data._data
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)
        self.load()


def arms_of(env: Any) -> Iterator[tuple[Any, str]]:
    """Every arm of an environment: robosuite's robot and the arm's name in it."""
    for robot in env.robots:
        for arm in robot.arms:
            yield robot, arm


def action_start(env: Any, robot: Any, part: str) -> int:
    """Where the action of a robot's part begins in the environment's."""
    before = sum(other.action_dim for other in env.robots[: env.robots.index(robot)])
    return before + robot.composite_controller._action_split_indexes[part][0]


def _arm(env: Any, robot: Any, arm: str) -> dict[str, Any]:
    """One arm's record, `step_records.ARM`."""
    part, model = robot.composite_controller.part_controllers[arm], env.sim.model._model
    part.scale_action(np.zeros(part.control_dim))  # fills in its scale
    actuators = np.array(robot._ref_actuators_indexes_dict[arm])
    n, osc = len(part.qpos_index), part.name in OSC_NAMES
    goal_low, goal_high = np.full(n, -np.inf), np.full(n, np.inf)
    if not osc:
        limits = {"JOINT_POSITION": "position", "JOINT_VELOCITY": "velocity", "JOINT_TORQUE": "torque"}[part.name]
        found = getattr(part, f"{limits}_limits")
        if found is not None:
            goal_low[:], goal_high[:] = found
    base = env.sim.model.site_name2id(f"{part.naming_prefix}{part.part_name}_center")
    return {
        "qpos": np.array(part.qpos_index),
        "qvel": np.array(part.qvel_index),
        "actuators": actuators,
        "torque_low": model.actuator_ctrlrange[actuators, 0],
        "torque_high": model.actuator_ctrlrange[actuators, 1],
        "mass_at": _mass_addresses(model)[np.ix_(part.qvel_index, part.qvel_index)],
        "kp": getattr(part, "kp", np.zeros(n)),
        "kd": getattr(part, "kd", np.zeros(n)),
        "ki": getattr(part, "ki", np.zeros(n)),
        "input_low": part.input_min,
        "input_high": part.input_max,
        "scale": part.action_scale,
        "input_middle": part.action_input_transform,
        "output_middle": part.action_output_transform,
        "goal_low": goal_low,
        "goal_high": goal_high,
        "kind": records.OSC if osc else 1 + JOINT_NAMES.index(part.name),
        "joints": n,
        "site": env.sim.model.site_name2id(part.ref_name),
        "action_at": action_start(env, robot, arm),
        "width": part.control_dim,
        "turns": part.name == "OSC_POSE",
        "uncoupled": osc and bool(part.uncoupling),
        "base_site": base,
        "base_moves": model.body_weldid[model.site_bodyid[base]] != 0,
    }


def _gripper(env: Any, robot: Any, arm: str) -> dict[str, Any]:
    """One gripper's record, `step_records.GRIPPER`; without fingers where the arm has none."""
    gripper, model = robot.gripper[arm], env.sim.model._model
    if not gripper.dof:
        return {"fingers": 0}
    driven = robot._ref_actuators_indexes_dict[f"{arm}_gripper"]
    low, high = model.actuator_ctrlrange[driven].T
    return {
        "action_at": action_start(env, robot, f"{arm}_gripper"),
        "fingers": len(driven),
        "actuators": np.array(driven),
        "step": _moved(gripper, np.zeros(len(driven)), 1.0),
        "middle": 0.5 * (high + low),
        "reach": 0.5 * (high - low),
    }


def _moved(gripper: Any, position: np.ndarray, action: float) -> np.ndarray:
    """Where robosuite moves a gripper from `position`."""
    before = gripper.current_action
    gripper.current_action = position.copy()
    moved = np.array(gripper.format_action(np.full(gripper.dof, action)), dtype=float)
    gripper.current_action = before
    return moved


def _moves_by_sign(gripper: Any, fingers: int) -> bool:
    """Whether a gripper moves as `step_records.GRIPPER` says; robosuite's dexterous hands do not."""
    if gripper.dof != 1:
        return False
    still = np.zeros(fingers)
    step = _moved(gripper, still, 1.0)
    if step.shape != still.shape:
        return False
    return all(
        np.array_equal(_moved(gripper, at, action), np.clip(at + step * np.sign(action), -1.0, 1.0))
        for at in (still, np.full(fingers, 0.95), np.full(fingers, -0.95))
        for action in (-1.0, -0.3, 0.0, 0.3, 1.0)
    )


def _mass_addresses(model: Any) -> np.ndarray:
    """Where each entry of the mass matrix, (nv, nv), stands in mjData.qM; -1 for those that are always zero."""
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, full, np.arange(1.0, model.nM + 1))
    return full.astype(np.int64) - 1


def _records(kind: np.dtype, rows: list[dict[str, Any]]) -> np.ndarray:
    """Records of a structured type; arrays that are shorter than their field are followed by zeros."""
    made = np.zeros(len(rows), kind)
    for record, row in zip(made, rows, strict=True):
        for name, value in row.items():
            if np.ndim(value):
                record[name][tuple(slice(length) for length in np.shape(value))] = value
            else:
                record[name] = value
    return made


def uncovered(env: Any) -> str:
    """What of an environment the compiled step does not cover; empty when it covers everything."""
    if mujoco.__version__ != MUJOCO:
        return f"mujoco {mujoco.__version__}, only {MUJOCO}"
    if not env.lite_physics:
        return "lite_physics=False"
    for robot in env.robots:
        controller = robot.composite_controller
        if controller.name != "BASIC":
            return f"the composite controller {controller.name}"
        parts = controller.part_controllers
        others = set(parts) - set(robot.arms) - {f"{arm}_gripper" for arm in robot.arms}
        if others:
            return f"the parts {', '.join(sorted(others))}"
        for arm in robot.arms:
            reason = _uncovered_arm(parts[arm])
            if not reason and robot.gripper[arm].dof:
                reason = _uncovered_gripper(parts[f"{arm}_gripper"], robot.gripper[arm])
            if reason:
                return reason
    return ""


def _uncovered_arm(part: Any) -> str:
    if part.name not in OSC_NAMES + JOINT_NAMES:
        return f"the controller {part.name}"
    if part.joint_dim > records.JOINTS:
        return f"an arm of {part.joint_dim} joints"
    if any(getattr(part, name, None) is not None for name in ("interpolator", "interpolator_pos", "interpolator_ori")):
        return "interpolators"
    as_it_is = {"impedance_mode": "fixed", "input_type": "delta", "input_ref_frame": "base"}
    for name, wanted in as_it_is.items():
        if getattr(part, name, wanted) != wanted:
            return f"{name} {getattr(part, name)}"
    if part.name in OSC_NAMES and (part.position_limits is not None or part.orientation_limits is not None):
        return "limits on the pose of the hand"
    return ""


def _uncovered_gripper(grip: Any, gripper: Any) -> str:
    plain = {grip.input_max.max(), grip.output_max.max()} == {1.0} == {-grip.input_min.min(), -grip.output_min.min()}
    simple = type(grip).__name__ == "SimpleGripController"
    if not (simple and grip.use_action_scaling and grip.interpolator is None and plain):
        return f"the gripper controller {type(grip).__name__} as it is configured"
    if not _moves_by_sign(gripper, grip.control_dim):
        return f"the gripper {type(gripper).__name__}"
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
