"""A table that a robosuite arm shares with a person's hand: both reach for one of three cubes.

The arm is robosuite's Panda with OSC_POSITION. The action is the velocity that its goal should have [m/s]; what keeps
the gripper off the hand is below it (`lfd.worlds.shared_table_guard`), whoever acts. The hand goes where the person
wants to, at `HAND_SPEED` at the most. The first cube that it comes to, it takes, and what it took moves along.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from lfd.core.channels import WXYZ, XYZ
from lfd.core.errors import InputError, SimulationError
from lfd.core.protocols import Observation, StepResult, WorldSpec, WorldState
from lfd.worlds.cameras import load_model
from lfd.worlds.robosuite_world import INTEGRATION, make_world
from lfd.worlds.shared_table_guard import (
    GOAL_HIGH,
    GOAL_LOW,
    GOAL_SPEED,
    HAND_HEIGHT,
    HAND_SPEED,
    LEAST_DISTANCE,
    TICK_S,
    TRACKING,
    guarded,
    is_allowed,
)
from lfd.worlds.shared_table_model import BODIES, HALF_M, HAND, HAND_JOINTS, OBJECTS, cube_joint, shared_table_xml

TASK = "shared_table"
TABLE_HEIGHT = 0.8
PLACES = {"left": (0.04, 0.32), "middle": (0.04, 0.0), "right": (0.04, -0.32)}
"""Of the cubes, but for `JITTER` [m]."""
JITTER = 0.02
HAND_HOME = (0.38, 0.0)
"""Where the hand begins, but for `HAND_JITTER`, and where it takes a cube [m]."""
HAND_JITTER = (0.04, 0.1)
HAND_LOW, HAND_HIGH = np.array([-0.1, -0.45]), np.array([0.5, 0.45])
"""How far the person reaches [m]."""
START_M, TOWARDS_START = np.array([-0.18, 0.0, 1.05]), 80
"""Where the gripper begins, but for `JOINT_NOISE` [m]; steps of `TICK_S` in which the arm goes there from its home."""
JOINT_NOISE = 0.02
"""Standard deviation of the arm's joints about their start, as robosuite has it [rad]."""
ABOVE_M = 0.06
"""Height of the grip site above a cube's centre where it is about to grasp it [m]."""
NEAR_M = 0.03
"""Distance from there up to which the gripper is at a cube, and distance up to which the hand is [m]."""
CARRIED_M = HAND_HEIGHT - 0.035
"""Height of a cube's centre in the hand [m]; it stands on the table below `LIFTED_M`."""
LIFTED_M = TABLE_HEIGHT + HALF_M + 0.01
REST_M = TABLE_HEIGHT + HALF_M + 0.001
FAR_M = 10.0
"""Beyond which distances are not measured [m]."""
OPEN = -1.0
DELTA_M = 0.05
"""By which OSC_POSITION moves its goal at full action [m]."""


@dataclass(frozen=True)
class Table:
    """What there is to see: where gripper, hand and cubes are, in the world."""

    gripper: Float[np.ndarray, "3"]
    """Of the grip site [m]."""
    goal: Float[np.ndarray, "3"]
    """What the arm's controller holds [m]."""
    hand: Float[np.ndarray, "2"]
    """x and y [m]."""
    cubes: Float[np.ndarray, "3 2"]
    """x and y of `OBJECTS` [m]."""
    taken: int | None
    """Number of the cube in the hand."""


class TablePerson(Protocol):
    """Moves the hand."""

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, "D"]:
        """Theta of a new episode's person: what they are after."""
        ...

    def answer(
        self, theta: Float[np.ndarray, "D"], table: Table, action: Float[np.ndarray, "3"], draw: float
    ) -> Float[np.ndarray, "2"]:
        """The hand's velocity [m/s], having seen the table and the robot's action; `draw` from [0, 1) decides."""
        ...


class SharedTableWorld:
    """The table with an arm and a person's hand.

    A step is one or more of `TICK_S`; the goal is guarded and the hand moves in each of them. An episode breaks off
    where the distance is below its limit, or the arm farther off its goal than the limit's proof allows. The person's
    theta and the seed of their draws are in the world's memory, not in what it shows.
    """

    def __init__(self, person: TablePerson, control_hz: int):
        """Raises `InputError` for a rate whose step is not a multiple of `TICK_S`."""
        rate = round(1.0 / TICK_S)
        if control_hz < 1 or rate % control_hz:
            raise InputError(f"control_hz = {control_hz}: give one of 1, 2, 4, 5, 10, {rate}")
        self._person, self._ticks, self._dt = person, rate // control_hz, 1.0 / control_hz
        self._arm = make_world("Lift", "panda", rate, controller="OSC_POSITION")
        self._goal, self._theta, self._seed = np.zeros(3), np.zeros(0), 0
        self._bring_in()
        labels = {name: axes for name, axes in self._arm.spec.labels.items() if not name.startswith(("cube", "action"))}
        for name in (*OBJECTS, "hand"):
            labels |= {f"{name}_pos": XYZ, f"{name}_quat": WXYZ}
        labels |= {"hand_distance": ("distance",), "goal_point": XYZ, "action": XYZ}
        self.spec = WorldSpec(
            task=TASK,
            instruction="reach for a cube that the person does not take, and keep off their hand",
            robot="panda",
            controller="GUARDED_VELOCITY",
            control_hz=control_hz,
            labels=labels,
            action_low=np.full(3, -GOAL_SPEED),
            action_high=np.full(3, GOAL_SPEED),
            stepper=self._arm.spec.stepper,
        )
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> Observation:
        """Draw the arm's posture, places of the cubes and of the hand, and the person."""
        model, data = self._arm._model, mujoco.MjData(self._arm._model)
        mujoco.mj_setState(model, data, np.array(self._begin.sim), INTEGRATION)
        arm = [model.joint(name).qposadr[0] for name in self.spec.labels["joint_pos"]]
        data.qpos[arm] += JOINT_NOISE * rng.normal(size=len(arm))
        for name in OBJECTS:
            place = np.array(PLACES[name]) + rng.uniform(-JITTER, JITTER, 2)
            data.joint(cube_joint(name)).qpos[:] = [*place, REST_M, 1.0, 0.0, 0.0, 0.0]
        hand = np.array(HAND_HOME) + rng.uniform(-1.0, 1.0, 2) * HAND_JITTER
        for joint, value in zip(HAND_JOINTS, hand, strict=False):
            data.joint(joint).qpos[:] = value
        self._seed, self._theta = int(rng.integers(2**31)), self._person.draw(rng)
        mujoco.mj_forward(model, data)
        sim = np.empty(len(self._begin.sim))
        mujoco.mj_getState(model, data, sim, INTEGRATION)
        self._arm.set_state(replace(self._begin, sim=sim))
        self._arm.settle()
        self._goal = np.clip(self._arm.observe()[self._arm.layout["ee_pos"]], GOAL_LOW, GOAL_HIGH)
        assert is_allowed(self._goal, hand)
        return self._observe()

    def step(self, action: Float[np.ndarray, "Da"]) -> StepResult:
        """Move arm and hand for one control step; what is beyond the limits is clipped.

        Raises `InputError` for an action of another shape or one that is not finite.
        """
        if action.shape != (3,) or not np.isfinite(action).all():
            raise InputError(f"the action is {action}; give a finite velocity in x, y and z")
        applied = np.clip(action, self.spec.action_low, self.spec.action_high)
        number = round(self._arm._data.time / self._dt)
        draw = np.random.default_rng([self._seed, number]).random()
        velocity = self._person.answer(self._theta, self._table(), applied, draw)
        velocity = velocity * min(1.0, HAND_SPEED / max(float(np.linalg.norm(velocity)), 1e-12))
        failure = ""
        for _ in range(self._ticks):
            failure = failure or self._tick(applied, velocity)
        seen = self._observe()
        done = not failure and self.is_done()
        return StepResult(seen, -self._dt * (not done), done, bool((applied != action).any()), failure)

    def is_done(self) -> bool:
        """Whether the gripper is above a cube that the person has not taken."""
        table = self._table()
        free = [i for i in range(len(OBJECTS)) if i != table.taken]
        goals = np.column_stack([table.cubes[free], np.full(len(free), REST_M + ABOVE_M)])
        return bool((np.linalg.norm(goals - table.gripper, axis=1) <= NEAR_M).any())

    def sim_state(self) -> Float[np.ndarray, "_"]:
        """MuJoCo's mjSTATE_INTEGRATION now."""
        return self._arm.sim_state()

    def pictures(self) -> Mapping[str, UInt8[np.ndarray, "H W 3"]]:
        """None: nobody asks this world for pictures."""
        return {}

    def get_state(self) -> WorldState:
        """The arm's, the controller's goal, the person's theta, and the seed of their draws."""
        state = self._arm.get_state()
        own = {"theta": np.array(self._theta, dtype=float), "seed": np.array(float(self._seed)), "goal": self._goal}
        return replace(state, memory={**state.memory, **own})

    def set_state(self, state: WorldState) -> Observation:
        """Go to a state. Raises `SimulationError` when it is not of a shared table."""
        if f'"{HAND}"' not in state.model_xml or "goal" not in state.memory:
            raise SimulationError(f"the state is none of the scene {TASK!r}; make a world of its scene")
        own = {name: np.array(state.memory[name], dtype=float) for name in ("theta", "seed", "goal")}
        others = {name: value for name, value in state.memory.items() if name not in own}
        self._arm.set_state(replace(state, memory=others))
        self._bind()
        self._theta, self._seed, self._goal = own["theta"], int(own["seed"]), own["goal"]
        return self._observe()

    def _bring_in(self) -> None:
        """Put cubes and hand into the arm's model."""
        lift = self._arm.get_state()
        before, xml = load_model(lift.model_xml), shared_table_xml(lift.model_xml)
        model = load_model(xml)
        data, was = mujoco.MjData(model), mujoco.MjData(before)
        mujoco.mj_setState(before, was, np.array(lift.sim), INTEGRATION)
        for joint in (before.joint(i).name for i in range(before.njnt)):
            if joint != cube_joint("middle"):
                data.joint(joint).qpos[:] = was.joint(joint).qpos
        for name in OBJECTS:
            data.joint(cube_joint(name)).qpos[:] = [*PLACES[name], REST_M, 1.0, 0.0, 0.0, 0.0]
        for joint, value in zip(HAND_JOINTS, HAND_HOME, strict=False):
            data.joint(joint).qpos[:] = value
        sim = np.empty(mujoco.mj_stateSize(model, INTEGRATION))
        mujoco.mj_getState(model, data, sim, INTEGRATION)
        self._arm.set_state(WorldState(model_xml=xml, sim=sim, memory=lift.memory))
        self._bind()
        for _ in range(TOWARDS_START):
            self._go(START_M)
        data = self._arm._data
        data.time, data.qvel[:] = 0.0, 0.0
        self._begin = self._arm.get_state()

    def _bind(self) -> None:
        """Find the hand's ball and the collision geoms of gripper and links in the present model."""
        model = self._arm._model
        self._ball = model.geom(f"{HAND}_ball").id
        bodies = {b for b in range(model.nbody) if model.body(b).name.startswith(("gripper0", "robot0"))}
        self._solid = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies and model.geom_group[g] == 0]

    def _tick(self, wanted: Float[np.ndarray, "3"], velocity: Float[np.ndarray, "2"]) -> str:
        """Arm and hand for `TICK_S`; why it cannot go on, if so."""
        hand = self._hand()
        self._goal = guarded(self._goal, hand, wanted)
        moved = np.clip(hand + TICK_S * velocity, HAND_LOW, HAND_HIGH)
        result = self._go(self._goal)
        if result.failure:
            return result.failure
        self._move(moved, (moved - hand) / TICK_S)
        off = float(np.linalg.norm(self._arm.observe()[self._arm.layout["ee_pos"]] - self._goal))
        apart, now = self.distance(), f"after t = {self._arm._data.time:.2f} s"
        if apart < LEAST_DISTANCE:
            return f"arm and hand were {apart:.3f} m apart {now}, the limit is {LEAST_DISTANCE} m"
        if off > TRACKING:
            return f"the gripper was {off:.3f} m off its goal {now}; the limit is proven for {TRACKING:.3f} m"
        return ""

    def _go(self, goal: Float[np.ndarray, "3"]) -> StepResult:
        """The arm for `TICK_S`, its gripper open."""
        gripper = self._arm.observe()[self._arm.layout["ee_pos"]]
        return self._arm.step(np.append(np.clip((goal - gripper) / DELTA_M, -1.0, 1.0), OPEN))

    def distance(self) -> float:
        """Between the surfaces of the collision geoms of gripper and links and the hand's ball [m]."""
        model, data = self._arm._model, self._arm._data
        return min(mujoco.mj_geomDistance(model, data, geom, self._ball, FAR_M, None) for geom in self._solid)

    def _move(self, hand: Float[np.ndarray, "2"], velocity: Float[np.ndarray, "2"]) -> None:
        """Put the hand and what it holds where they are after a tick; a cube that it has come to, it takes."""
        table, model, data = self._table(), self._arm._model, self._arm._data
        for joint, place, speed in zip(HAND_JOINTS, (*hand, 0.0), (*velocity, 0.0), strict=True):
            data.joint(joint).qpos[:], data.joint(joint).qvel[:] = place, speed
        taken = table.taken
        if taken is None:
            away = np.linalg.norm(table.cubes - hand, axis=1)
            taken = int(away.argmin()) if away.min() <= NEAR_M else None
        if taken is not None:
            cube = data.joint(cube_joint(OBJECTS[taken]))
            cube.qpos[:] = [*hand, CARRIED_M, 1.0, 0.0, 0.0, 0.0]
            cube.qvel[:] = [*velocity, 0.0, 0.0, 0.0, 0.0]
        mujoco.mj_step1(model, data)  # what follows from positions, as it stands after a control step

    def _hand(self) -> Float[np.ndarray, "2"]:
        return np.array([self._arm._data.joint(joint).qpos[0] for joint in HAND_JOINTS[:2]])

    def _table(self) -> Table:
        return seen_table(self._seen())

    def _seen(self) -> dict[str, Float[np.ndarray, "_"]]:
        """What the person sees as well."""
        data = self._arm._data
        seen = {f"{name}_pos": data.body(BODIES[name]).xpos.copy() for name in OBJECTS}
        seen["hand_pos"] = data.body(HAND).xpos.copy()
        seen["ee_pos"], seen["goal_point"] = self._arm.observe()[self._arm.layout["ee_pos"]], self._goal.copy()
        return seen

    def _observe(self) -> Observation:
        arm = self._arm.observe()
        seen = {name: arm[place] for name, place in self._arm.layout.items() if not name.startswith("cube")}
        seen |= self._seen()
        for name in OBJECTS:
            seen[f"{name}_quat"] = self._arm._data.body(BODIES[name]).xquat.copy()
        seen["hand_quat"] = self._arm._data.body(HAND).xquat.copy()
        seen["hand_distance"] = np.array([self.distance()])
        return seen


def seen_table(observation: Observation) -> Table:
    """The table, as observed."""
    cubes = np.array([observation[f"{name}_pos"] for name in OBJECTS])
    lifted = np.flatnonzero(cubes[:, 2] > LIFTED_M)
    return Table(
        gripper=np.array(observation["ee_pos"]),
        goal=np.array(observation["goal_point"]),
        hand=np.array(observation["hand_pos"][:2]),
        cubes=cubes[:, :2],
        taken=int(lifted[0]) if len(lifted) else None,
    )
