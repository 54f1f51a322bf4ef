"""robosuite environments as worlds. The only module that imports robosuite.

robosuite builds the model, draws start states, runs its controllers and judges success; observations are
read from MjData after the step, so that they belong to the state that the next action acts on (robosuite's
own observables lag by one physics step). The control step itself is compiled where it can be
(`lfd.worlds.steppers`).
"""

import logging
import threading
import warnings
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from lfd.core.channels import WXYZ, XYZ
from lfd.core.errors import InputError, SimulationError, UnknownName
from lfd.core.protocols import Observation, StepResult, WorldSpec, WorldState
from lfd.worlds.drawn_sizes import draw_sizes
from lfd.worlds.robots import CONTROLLERS, RobotConfig, load_robot
from lfd.worlds.steppers import make_stepper, uncovered
from lfd.worlds.tasks import TASKS

SELF_CHECK_TOLERANCE = 1e-9
INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
logger = logging.getLogger(__name__)
_GLOBAL_RANDOM = threading.Lock()  # robosuite 1.5.1 draws from numpy's global generator


def import_robosuite() -> Any:
    """robosuite, without its messages about optional parts that lfd does not use."""
    logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)  # escape sequences in robosuite's docstrings
        import robosuite
    return robosuite


def make_environment(task: str, robot: RobotConfig, control_hz: int, **options: Any) -> Any:
    """robosuite's own environment, without rendering; `options` go to `robosuite.make`."""
    robosuite = import_robosuite()
    from robosuite.controllers import load_composite_controller_config, load_part_controller_config

    config: Any = load_composite_controller_config(controller="BASIC", robot=robot.robosuite_name)
    arm = config["body_parts"]["right"]
    config["body_parts"] = {"right": load_part_controller_config(default_controller=robot.controller)}
    config["body_parts"]["right"] |= {key: arm[key] for key in ("gripper", "input_type", "input_ref_frame")}
    return robosuite.make(
        task,
        robots=robot.robosuite_name,
        controller_configs=config,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        control_freq=control_hz,
        ignore_done=True,
        **options,
    )


class RobosuiteWorld:
    """A robosuite task with one arm.

    Observation channels: `joint_pos` [rad], `joint_vel` [rad/s], `joint_effort` [N m] of the arm,
    `gripper_pos` [m], `gripper_vel` [m/s], `gripper_effort` [N] of the fingers, `ee_pos` [m] and `ee_quat`
    (wxyz) of the grip site, and `NAME_pos` [m], `NAME_quat` (wxyz) of each object, poses in the world frame.
    The action is the controller's input in [-1, 1] and the gripper's (-1 open, 1 close).

    Raises `UnknownName` for a task that lfd does not know.
    """

    def __init__(self, *, task: str, robot_name: str, robot: RobotConfig, control_hz: int, stepper: str = "auto"):
        if task not in TASKS:
            raise UnknownName("task", task, TASKS)
        self._env = make_environment(task, robot, control_hz)
        for observable in self._env._observables.values():
            observable.set_enabled(False)  # read by nobody here
        self._task, self._wanted = task, stepper
        self._attach()
        if stepper == "auto":
            self._choose_stepper()
        self.spec = WorldSpec(
            task=task,
            instruction=TASKS[task],
            robot=robot_name,
            controller=robot.controller,
            control_hz=control_hz,
            labels=self._labels(robot),
            action_low=self._env.action_spec[0],
            action_high=self._env.action_spec[1],
            stepper=self._stepper.name,
        )

    @property
    def step_backend(self) -> str:
        """What computes the control steps: compiled or robosuite."""
        return self._stepper.name

    def reset(self, rng: np.random.Generator) -> Observation:
        """Draw a start state as robosuite does: object sizes and poses, joint noise.

        The model is not rebuilt, unless `set_state` brought another one in.
        """
        seed = int(rng.integers(2**32))
        self._env.hard_reset = self._is_guest
        with _GLOBAL_RANDOM:
            outside = np.random.get_state()
            np.random.seed(seed)
            try:
                if not self._is_guest:
                    draw_sizes(self._task, self._env)
                self._env.reset()
            finally:
                np.random.set_state(outside)
        if self._is_guest:
            self._attach()
        self._model_xml = None
        return self._observe()

    def step(self, action: Float[np.ndarray, "Da"]) -> StepResult:
        """Apply an action for one control step; values outside the limits are clipped by the controller.

        Raises `InputError` for an action of another shape or one that is not finite, `SimulationError` when
        the physics becomes unstable.
        """
        expected = self.spec.action_low.shape
        if action.shape != expected:
            raise InputError(f"the action has shape {action.shape}, {self.spec.robot} takes {expected}")
        if not np.isfinite(action).all():
            raise InputError(f"the action is not finite: {action}")
        self._stepper.step(action)
        for kind in UNSTABLE:
            if self._data.warning[kind].number:
                raise SimulationError(f"MuJoCo reports {mujoco.mjtWarning(kind).name} at t = {self._data.time:.3f} s")
        return StepResult(self._observe(), float(self._env.reward(action)), bool(self._env._check_success()))

    def sim_state(self) -> Float[np.ndarray, "_"]:
        """MuJoCo's mjSTATE_INTEGRATION now."""
        state = np.empty(mujoco.mj_stateSize(self._model, INTEGRATION))
        mujoco.mj_getState(self._model, self._data, state, INTEGRATION)
        return state

    def get_state(self) -> WorldState:
        """Everything that decides the future: physics, controllers, gripper, and the model itself."""
        return WorldState(model_xml=self._portable_xml(), sim=self.sim_state(), memory=self._memory())

    def set_state(self, state: WorldState) -> Observation:
        """Go to `state`, rebuilding the model when it belongs to another one.

        Raises `SimulationError` when the state does not fit the model.
        """
        if state.model_xml != self._portable_xml():
            with _GLOBAL_RANDOM:
                self._env.reset_from_xml_string(state.model_xml)
            self._attach(state.model_xml)
        expected = mujoco.mj_stateSize(self._model, INTEGRATION)
        if state.sim.shape != (expected,):
            raise SimulationError(f"the state has {state.sim.shape} numbers, the model's has {expected}")
        sim = np.array(state.sim)  # MuJoCo wants an array that can be written
        for _ in range(2):  # mj_forward moves the solver's warm start, which is part of the state
            mujoco.mj_setState(self._model, self._data, sim, INTEGRATION)
            mujoco.mj_forward(self._model, self._data)
        mujoco.mj_setState(self._model, self._data, sim, INTEGRATION)
        self._set_memory(state.memory)
        return self._observe()

    def _attach(self, model_xml: str | None = None) -> None:
        """Look up where the present model keeps what observations are read from."""
        sim = self._env.sim
        self._model, self._data = sim.model._model, sim.data._data
        self._model_xml, self._is_guest = model_xml, model_xml is not None
        robot = self._env.robots[0]
        grip = robot.gripper["right"]
        names = {"joint": robot.robot_model.arm_joints, "gripper": grip.joints}
        self._joints = {kind: [self._model.joint(name) for name in joints] for kind, joints in names.items()}
        self._qpos = {kind: np.array([j.qposadr[0] for j in joints]) for kind, joints in self._joints.items()}
        self._qvel = {kind: np.array([j.dofadr[0] for j in joints]) for kind, joints in self._joints.items()}
        self._grip_site = self._model.site(grip.important_sites["grip_site"]).id
        self._objects = {o.name: self._model.body(o.root_body).id for o in self._env.model.mujoco_objects}
        self._stepper = make_stepper(self._wanted, self._env)

    def _choose_stepper(self) -> None:
        """Keep the compiled step if one step of it gives robosuite's numbers; say so and take robosuite's if not."""
        start = self.get_state()
        action = np.linspace(-0.5, 0.5, len(self._env.action_spec[0]))
        states = {}
        for name in dict.fromkeys((self._stepper.name, "robosuite")):
            self.set_state(start)
            make_stepper(name, self._env).step(action)
            states[name] = np.concatenate([self._data.qpos, self._data.qvel, self._data.ctrl])
        self.set_state(start)
        away = float(np.abs(states[self._stepper.name] - states["robosuite"]).max())
        if away > SELF_CHECK_TOLERANCE or self._stepper.name == "robosuite":
            reason = uncovered(self._env) or f"this machine (one step differs by {away:.1e})"
            logger.warning(
                "robosuite's own step is used, several times slower: the compiled one does not cover %s", reason
            )
            self._wanted = "robosuite"
            self._stepper = make_stepper("robosuite", self._env)

    def _labels(self, robot: RobotConfig) -> Mapping[str, tuple[str, ...]]:
        labels: dict[str, tuple[str, ...]] = {}
        for kind, joints in self._joints.items():
            names = tuple(joint.name for joint in joints)
            labels |= {f"{kind}_pos": names, f"{kind}_vel": names, f"{kind}_effort": names}
        for body in ("ee", *self._objects):
            labels |= {f"{body}_pos": XYZ, f"{body}_quat": WXYZ}
        return labels | {"action": (*CONTROLLERS[robot.controller], "gripper")}

    def _observe(self) -> Observation:
        data, seen = self._data, {}
        for kind in self._joints:
            seen[f"{kind}_pos"] = data.qpos[self._qpos[kind]]
            seen[f"{kind}_vel"] = data.qvel[self._qvel[kind]]
            seen[f"{kind}_effort"] = data.qfrc_actuator[self._qvel[kind]]
        seen["ee_pos"] = data.site_xpos[self._grip_site].copy()
        seen["ee_quat"] = np.empty(4)
        mujoco.mju_mat2Quat(seen["ee_quat"], data.site_xmat[self._grip_site])
        for name, body in self._objects.items():
            seen[f"{name}_pos"], seen[f"{name}_quat"] = data.xpos[body].copy(), data.xquat[body].copy()
        return seen

    def _portable_xml(self) -> str:
        """The model as XML, mesh and texture paths starting with `robosuite/`, numbers in full."""
        if self._model_xml is None:
            assets = str(self._env.model.mujoco_arena.folder).partition("robosuite/models/assets")[0]
            self._model_xml = self._env.model.get_xml().replace(f'"{assets}robosuite/', '"robosuite/')
        return self._model_xml

    def _parts(self) -> dict[str, Any]:
        """What has a memory between control steps: the part controllers and the gripper."""
        robot = self._env.robots[0]
        return {**robot.composite_controller.part_controllers, "gripper": robot.gripper["right"]}

    def _memory(self) -> dict[str, np.ndarray]:
        """Goals, null-space targets, and the Jacobian and mass matrix that the first substep after a reset
        still takes from the controllers' construction."""
        kept: dict[str, np.ndarray] = {}
        for part, holder in self._parts().items():
            for name, value in vars(holder).items():
                if isinstance(value, np.ndarray) and value.dtype.kind == "f":
                    kept[f"{part}.{name}"] = value.copy()
            if hasattr(holder, "new_update"):
                kept[f"{part}.new_update"] = np.array(float(holder.new_update))
        return kept

    def _set_memory(self, memory: Mapping[str, np.ndarray]) -> None:
        for key, value in memory.items():
            part, _, name = key.partition(".")
            setattr(self._parts()[part], name, bool(value) if name == "new_update" else np.array(value))


def make_world(task: str, robot: str, control_hz: int, stepper: str = "auto") -> RobosuiteWorld:
    """The world of a task and a robot config, by their names.

    `stepper` is `compiled`, `robosuite`, or `auto`: the compiled one where it covers the robot and gives
    robosuite's numbers. Raises `UnknownName` for a task, robot or stepper that lfd does not know.
    """
    config = load_robot(robot)
    return RobosuiteWorld(task=task, robot_name=robot, robot=config, control_hz=control_hz, stepper=stepper)
