"""robosuite environments as worlds.

robosuite builds the model, draws start states, configures its controllers and judges reward and success;
observations are read from MjData after the step (`lfd.worlds.observing`), so that they belong to the state that
the next action acts on (robosuite's own observables lag by one physics step). The control step itself is
compiled where it can be (`lfd.worlds.steppers`).
"""

import logging
import random
import threading
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from lfd.core.errors import InputError, SimulationError
from lfd.core.processes import cores
from lfd.core.protocols import Observation, Progress, StepResult, WorldSpec, WorldState, silent
from lfd.worlds.cameras import Cameras
from lfd.worlds.drawn_sizes import draw_sizes
from lfd.worlds.environments import PLACED, make_environment
from lfd.worlds.model_text import xml_text
from lfd.worlds.observing import Sight
from lfd.worlds.robots import CONTROLLERS, RobotConfig, load_robot
from lfd.worlds.same_numbers import compare
from lfd.worlds.steppers import action_start, arms_of, make_stepper, uncovered
from lfd.worlds.tasks import Task, load_task

INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
EVERY_CORE = 2**16
"""As many worlds as there are cores."""
logger = logging.getLogger(__name__)
_GLOBAL_RANDOM = threading.Lock()  # robosuite 1.5.1 draws from the global generators of numpy and Python


class RobosuiteWorld:
    """A task of robosuite with a robot; what it observes is described in `lfd.worlds.observing`.

    A new world stands in the start state of seed 0.

    The action is the concatenation, arm by arm, of the controller's input in [-1, 1] and the gripper's (-1 open,
    1 close).
    """

    def __init__(self, *, task: Task, robot_name: str, robot: RobotConfig, control_hz: int, stepper: str = "auto"):
        self._env = make_environment(task, robot, control_hz)
        for observable in self._env._observables.values():
            observable.set_enabled(False)  # read by nobody here
        self._task, self._wanted, self._has_clipped = task, stepper, False
        self._cameras: Cameras | None = None
        self._attach()
        if stepper == "auto":
            self._choose_stepper()
        low, high = self._env.action_spec
        self.spec = WorldSpec(
            task=task.name,
            instruction=task.instruction,
            robot=robot_name,
            controller=robot.controller,
            control_hz=control_hz,
            labels={**self._sight.labels, "action": self._action_names(robot)},
            action_low=np.asarray(low, dtype=float),
            action_high=np.asarray(high, dtype=float),
            stepper=self._stepper.name,
        )
        self.reset(np.random.default_rng(0))

    @property
    def step_backend(self) -> str:
        """What computes the control steps: compiled or robosuite."""
        return self._stepper.name

    @property
    def layout(self) -> Mapping[str, slice]:
        """Channel to its place in the vector that `observe` gives."""
        return self._sight.slices

    @property
    def observation_size(self) -> int:
        """Length of the vector that `observe` gives."""
        return self._sight.size

    def observe(self) -> Float[np.ndarray, "Do"]:
        """The present observation as one vector."""
        return self._sight.read().copy()

    def reset(self, rng: np.random.Generator) -> Observation:
        """Draw a start state as robosuite does: object sizes and poses, joint noise.

        The model is not rebuilt, unless `set_state` brought another one in.
        """
        seed = int(rng.integers(2**32))
        self._env.hard_reset = self._is_guest
        with _GLOBAL_RANDOM:
            outside, outside_python = np.random.get_state(), random.getstate()
            np.random.seed(seed)
            random.seed(seed)
            try:
                if not self._is_guest:
                    draw_sizes(self._task.name, self._env, self._scratch)
                self._env.reset()
            finally:
                np.random.set_state(outside)
                random.setstate(outside_python)
        if self._is_guest:
            self._attach()
        self._model_xml = None
        self._stepper.load()
        return self._observe()

    def step(self, action: Float[np.ndarray, "Da"]) -> StepResult:
        """Apply an action for one control step; what is beyond its limits is clipped, and said once.

        When MuJoCo reports that the physics became unstable, the world stays where it was before the step and
        `failure` says why. Raises `InputError` for an action of another shape or one that is not finite.
        """
        expected = self.spec.action_low.shape
        if action.shape != expected:
            raise InputError(f"the action has shape {action.shape}, {self.spec.robot} takes {expected}")
        if not np.isfinite(action).all():
            raise InputError(f"the action is not finite: {action}")
        clipped = bool((action < self.spec.action_low).any() or (action > self.spec.action_high).any())
        if clipped and not self._has_clipped:
            self._has_clipped = True
            logger.warning("actions beyond the limits of %s are clipped, as robosuite does", self.spec.robot)
        mujoco.mj_getState(self._model, self._data, self._before, INTEGRATION)
        self._stepper.step(np.asarray(action, dtype=np.float64))
        if self._warnings[self._unstable].any():
            return self._broken_off(clipped)
        reward, _, _ = self._env._post_action(action)
        return StepResult(self._observe(), float(reward), bool(self._env._check_success()), clipped)

    def push(self, body: str, wrench: Float[np.ndarray, "6"]) -> None:
        """Let a force [N] and a torque [N m] act at a body's centre, in the world frame, until told otherwise.

        They are part of the state. Raises `InputError` for a body that the model does not have.
        """
        found = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_BODY, body)
        if found < 0:
            raise InputError(f"no body {body!r} to push in {self.spec.task} with {self.spec.robot}")
        self._data.xfrc_applied[found] = wrench

    def sim_state(self) -> Float[np.ndarray, "_"]:
        """MuJoCo's mjSTATE_INTEGRATION now."""
        state = np.empty(len(self._before))
        mujoco.mj_getState(self._model, self._data, state, INTEGRATION)
        return state

    def take_cameras(self, names: Sequence[str], *, height: int, width: int) -> None:
        """Have `pictures` show what some of the model's cameras see; raises what `Cameras` raises."""
        self._cameras = Cameras(self._portable_xml(), names, height=height, width=width)
        self.spec = replace(self.spec, cameras=tuple(names))

    def pictures(self) -> Mapping[str, UInt8[np.ndarray, "H W 3"]]:
        """What the cameras of `take_cameras` see now, RGB; none without it."""
        if self._cameras is None:
            return {}
        self._cameras.follow(self._model)  # a reset may have changed sizes and places
        return self._cameras.render(self.sim_state())

    def get_state(self) -> WorldState:
        """Everything that decides the future: physics, controllers, grippers, the task's own memory, the model."""
        self._stepper.store()
        return WorldState(model_xml=self._portable_xml(), sim=self.sim_state(), memory=self._memory())

    def set_state(self, state: WorldState) -> Observation:
        """Go to `state`, rebuilding the model when it belongs to another one.

        Raises `SimulationError` when the state does not fit the model.
        """
        if state.model_xml != self._portable_xml():
            with _GLOBAL_RANDOM:
                self._env.reset_from_xml_string(state.model_xml)
            self._attach(state.model_xml)
        if state.sim.shape != self._before.shape:
            raise SimulationError(f"the state has {state.sim.shape} numbers, the model's has {self._before.shape}")
        self._set_memory(state.memory)
        self._put(state.sim)
        self._stepper.load()
        return self._observe()

    def show(self, state: Float[np.ndarray, "_"]) -> StepResult:
        """Go to a time, qpos and qvel, one after the other as in robosuite's files, and judge them.

        The rest stays as it is: controls, warm start, memory. Raises `SimulationError` for a state of another model.
        """
        nq, nv = self._model.nq, self._model.nv
        if state.shape != (1 + nq + nv,):
            raise SimulationError(f"the state has {len(state)} numbers, the model's has 1 + {nq} + {nv}")
        self._data.time, self._data.qpos[:], self._data.qvel[:] = state[0], state[1 : 1 + nq], state[1 + nq :]
        mujoco.mj_forward(self._model, self._data)
        self._warnings[:] = 0
        reward = self._env.reward(np.zeros_like(self.spec.action_low))
        return StepResult(self._observe(), float(reward), bool(self._env._check_success()))

    def settle(self) -> None:
        """Let the arms' controllers take the present state for the one that a reset ended in, in every respect."""
        for owner, arm in arms_of(self._env):
            part = owner.composite_controller.part_controllers[arm]
            part.update_initial_joints(self._data.qpos[part.qpos_index])
        self._stepper.load()

    def _put(self, sim_state: np.ndarray) -> None:
        """Set MuJoCo's state and compute what follows from it."""
        sim = np.array(sim_state)  # MuJoCo wants an array that can be written
        for _ in range(2):  # mj_forward moves the solver's warm start, which is part of the state
            mujoco.mj_setState(self._model, self._data, sim, INTEGRATION)
            mujoco.mj_forward(self._model, self._data)
        mujoco.mj_setState(self._model, self._data, sim, INTEGRATION)
        self._warnings[:] = 0

    def _broken_off(self, clipped: bool) -> StepResult:
        """The answer to an action that made the physics unstable: back to the state before it, with the reason."""
        kinds = [mujoco.mjtWarning(k).name for k in UNSTABLE if self._warnings[k]]
        self._put(self._before)
        failure = f"MuJoCo reports {', '.join(kinds)} after t = {self._data.time:.3f} s"
        return StepResult(self._observe(), 0.0, False, clipped, failure)

    def _attach(self, model_xml: str | None = None) -> None:
        """Bind to the present model."""
        sim = self._env.sim
        self._model, self._data = sim.model._model, sim.data._data
        self._model_xml, self._is_guest = model_xml, model_xml is not None
        self._before = np.empty(mujoco.mj_stateSize(self._model, INTEGRATION))
        self._scratch = mujoco.MjData(self._model)
        self._warnings, self._unstable = self._data.warning.number, [int(kind) for kind in UNSTABLE]
        self._sight = Sight(self._env, self._task)
        self._stepper = make_stepper(self._wanted, self._env)

    def _choose_stepper(self) -> None:
        """Keep the compiled step if one step of it gives robosuite's numbers; say so and take robosuite's if not."""
        reason = uncovered(self._env)
        if not reason:
            found = compare(self, [np.linspace(-0.5, 0.5, len(self._env.action_spec[0]))])
            reason = "" if found.is_same else f"this machine (one step differs by {found.ours:.1e})"
        if reason:
            logger.warning(
                "robosuite's own step is used, several times slower: the compiled one does not cover %s", reason
            )
            self._wanted = "robosuite"
            self._stepper = make_stepper("robosuite", self._env)

    def _action_names(self, robot: RobotConfig) -> tuple[str, ...]:
        """Names of the action's components; those of two arms begin with the arm's."""
        names = np.empty(len(self._env.action_spec[0]), dtype=object)
        arms = list(arms_of(self._env))
        for prefix, (owner, arm) in zip(self._sight.prefixes, arms, strict=True):
            part, gripper = owner.composite_controller.part_controllers[arm], owner.gripper[arm]
            begin = action_start(self._env, owner, arm)
            names[begin : begin + part.control_dim] = [
                f"{prefix}{name}" for name in CONTROLLERS[robot.controller] or part.joint_names
            ]
            if gripper.dof:
                names[action_start(self._env, owner, f"{arm}_gripper")] = f"{prefix}gripper"
        return tuple(names)

    def _observe(self) -> Observation:
        return self._sight.named(self.observe())

    def _portable_xml(self) -> str:
        """The model as XML, mesh and texture paths starting with `robosuite/`, numbers in full."""
        if self._model_xml is None:
            self._write_places()
            assets = str(self._env.model.mujoco_arena.folder).partition("robosuite/models/assets")[0]
            self._model_xml = xml_text(self._env.model.root).replace(f'"{assets}robosuite/', '"robosuite/')
        return self._model_xml

    def _write_places(self) -> None:
        """Write where a reset placed what cannot move into the XML."""
        elements: dict[str | None, ET.Element] = {}
        for field in PLACED:
            places = getattr(self._model, field)
            for body in np.flatnonzero((places != self._env.places_in_xml[field]).any(axis=1)):
                elements = elements or {e.get("name"): e for e in self._env.model.root.iter("body")}
                element = elements[self._model.body(body).name]
                if field == "body_quat":
                    for other in ("euler", "axisangle", "xyaxes", "zaxis"):
                        element.attrib.pop(other, None)
                element.set(field.removeprefix("body_"), " ".join(repr(float(x)) for x in places[body]))

    def _parts(self) -> dict[str, Any]:
        """What has a memory between control steps: the part controllers and the grippers."""
        parts = {}
        for robot in self._env.robots:
            for name, part in robot.composite_controller.part_controllers.items():
                parts[f"{robot.idn}.{name}"] = part
            for arm, gripper in robot.gripper.items():
                parts[f"{robot.idn}.{arm}_hand"] = gripper
        return parts

    def _memory(self) -> dict[str, np.ndarray]:
        """What robosuite's Python objects remember: the controllers' goals, filters and null-space targets, and what
        the first substep after a reset takes from their construction; where fixed things were placed; wiped dirt.
        """
        kept: dict[str, np.ndarray] = {}
        for part, holder in self._parts().items():
            for name, value in vars(holder).items():
                if isinstance(value, np.ndarray) and value.dtype.kind == "f":
                    kept[f"{part}.{name}"] = value.copy()
            for name in FLAGS:
                if hasattr(holder, name):
                    kept[f"{part}.{name}"] = np.array(float(getattr(holder, name)))
            if hasattr(holder, "derr_buf"):
                buffer = holder.derr_buf
                kept[f"{part}.derr_buf"] = np.append(buffer.buf, [buffer.ptr, buffer._size])
        for field, compiled in self._env.places_in_xml.items():
            if (getattr(self._model, field) != compiled).any():
                kept[f"model.{field}"], kept[f"compiled.{field}"] = getattr(self._model, field).copy(), compiled
        if hasattr(self._env, "wiped_markers"):
            wiped = {marker.name for marker in self._env.wiped_markers}
            kept["task.wiped"] = np.array([float(m.name in wiped) for m in self._env.model.mujoco_arena.markers])
        return kept

    def _set_memory(self, memory: Mapping[str, np.ndarray]) -> None:
        parts = self._parts()
        self._place(memory)
        for key, value in memory.items():
            part, _, name = key.rpartition(".")
            if part in ("model", "compiled"):
                continue
            if part == "task":
                self._wipe(value)
            elif name == "derr_buf":
                buffer = parts[part].derr_buf
                buffer.buf, (buffer.ptr, buffer._size) = (
                    value[:-2].reshape(buffer.buf.shape).copy(),
                    value[-2:].astype(int),
                )
            else:
                setattr(parts[part], name, bool(value) if name in FLAGS else np.array(value))

    def _place(self, memory: Mapping[str, np.ndarray]) -> None:
        """Put what cannot move where it was, in a model whose constants are those of the places it was compiled with.

        Those of a model that was compiled from the XML of a state belong to where the reset placed things: equal but
        for rounding, which contacts would amplify.
        """
        was = self._env.places_in_xml
        compiled = {field: memory.get(f"compiled.{field}", was[field]) for field in PLACED}
        for field in PLACED:
            getattr(self._model, field)[:] = compiled[field]
        if any((compiled[field] != was[field]).any() for field in PLACED):
            mujoco.mj_setConst(self._model, self._scratch)
            self._env.places_in_xml = {field: np.array(compiled[field]) for field in PLACED}
        for field in PLACED:
            getattr(self._model, field)[:] = memory.get(f"model.{field}", compiled[field])

    def _wipe(self, wiped: np.ndarray) -> None:
        """Make the marked dirt of the Wipe task wiped, and the rest not."""
        markers = self._env.model.mujoco_arena.markers
        self._env.wiped_markers = [m for m, gone in zip(markers, wiped, strict=True) if gone]
        for marker, gone in zip(markers, wiped, strict=True):
            self._model.geom(marker.visual_geoms[0]).rgba[3] = 1.0 - gone


FLAGS = ("new_update", "saturated")
"""Memories of controllers that are true or false."""


def make_world(
    task: str, robot: str, control_hz: int, stepper: str = "auto", *, controller: str | None = None
) -> RobosuiteWorld:
    """The world of a task and a robot config, by their names.

    `stepper` is `compiled`, `robosuite`, or `auto`: the compiled one where it covers the robot and gives
    robosuite's numbers. `controller` takes the place of the robot config's. Raises `UnknownName` for a task, robot,
    controller or stepper that lfd does not know.
    """
    known, config = load_task(task), load_robot(robot)
    if controller is not None:
        config = replace(config, controller=controller)
        config.check(f"robot {robot}")
    return RobosuiteWorld(task=known, robot_name=robot, robot=config, control_hz=control_hz, stepper=stepper)


def make_worlds(
    task: str, robot: str, control_hz: int, *, most: int, progress: Progress = silent
) -> list[RobosuiteWorld]:
    """A world for each core of this machine, `most` at the most."""
    count = max(1, min(most, cores()))
    worlds = []
    with progress(f"build {count} {'world' if count == 1 else 'worlds'}", count) as bar:
        for _ in range(count):  # the first time on a machine, the control step is compiled
            worlds.append(make_world(task, robot, control_hz))
            bar.advance()
    return worlds


@lru_cache(maxsize=1)
def kept_world(task: str, robot_name: str, robot: RobotConfig, control_hz: int) -> RobosuiteWorld:
    """The world of a worker that takes one unit of work after another: built once."""
    return RobosuiteWorld(task=load_task(task), robot_name=robot_name, robot=robot, control_hz=control_hz)
