"""Cars on a road: a robot, and a person who answers to what it does (the highway merge of chapter 10.6). Where the lane
is dense, a second car follows the person's, by `lfd.worlds.car_following`.

Cars are bicycles of the rear axle, one Euler step for each control step of dt:

    x' = x + v cos(yaw) dt                          y' = y + v sin(yaw) dt
    yaw' = yaw + v tan(steering) / wheelbase dt     v' = max(v + a dt, 0)

MuJoCo holds and draws the state, nothing is simulated with it: a car's joints are x, y, yaw, steering and the turn of
its wheels, whose rate is v / radius. Thus a recording has a model and states of the same kind as an arm's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from lfd.core.errors import InputError, SimulationError, UnknownName
from lfd.core.protocols import Observation, StepResult, WorldSpec, WorldState
from lfd.worlds.car_following import CarFollowing

LENGTH, WIDTH, WHEELBASE, RADIUS = 4.5, 1.8, 2.7, 0.33
"""Of a car and of its wheels [m]; its middle is half a wheelbase before the rear axle."""
LANE = 3.5
"""Width of a lane [m]."""
ACTION_LOW, ACTION_HIGH = np.array([-5.0, -0.06]), np.array([3.0, 0.06])
"""Limits of the robot's acceleration [m/s^2] and steering angle [rad]."""
ROBOT, PERSON, SECOND = CARS = "robot_car", "person_car", "second_car"
JOINTS = ("x", "y", "yaw", "steering", "wheels")
INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass(frozen=True)
class Car:
    """Where a car is and how fast it is; position and yaw are those of the rear axle, in the world."""

    x: float
    """[m]."""
    y: float
    """[m]."""
    yaw: float
    """[rad]."""
    speed: float
    """[m/s]."""

    def moved(self, acceleration: float, steering: float, dt: float) -> "Car":
        """The bicycle after one Euler step of dt [s]."""
        return Car(
            self.x + self.speed * np.cos(self.yaw) * dt,
            self.y + self.speed * np.sin(self.yaw) * dt,
            self.yaw + self.speed * np.tan(steering) / WHEELBASE * dt,
            max(self.speed + acceleration * dt, 0.0),
        )

    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Corners of its outline, counter-clockwise [m]."""
        along, left = np.array([np.cos(self.yaw), np.sin(self.yaw)]), np.array([-np.sin(self.yaw), np.cos(self.yaw)])
        middle = np.array([self.x, self.y]) + along * WHEELBASE / 2.0
        half = along * LENGTH / 2.0, left * WIDTH / 2.0
        return middle + np.array([half[0] - half[1], half[0] + half[1], half[1] - half[0], -half[0] - half[1]])


class Person(Protocol):
    """Drives the other car."""

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, "D"]:
        """Theta of a new episode's person: what they are after."""
        ...

    def answer(
        self, theta: Float[np.ndarray, "D"], robot: Car, person: Car, action: Float[np.ndarray, "2"], draw: float
    ) -> float:
        """Their acceleration [m/s^2], having seen both cars and the robot's action; `draw` from [0, 1) decides."""
        ...


@dataclass(frozen=True, kw_only=True)
class DrivingScene:
    """A road, and where cars begin on it. The robot is to drive along y = 0, in the direction of x."""

    name: str
    instruction: str
    heading: float
    """Direction in which the person drives [rad]; their path passes through the origin."""
    robot_y: float
    """Where the robot begins beside its line [m]."""
    robot_x: tuple[float, float]
    """Lowest and highest start along it [m]."""
    person_start: tuple[float, float]
    """Lowest and highest start of the person along their path, from the origin [m]."""
    speeds: tuple[float, float]
    """Lowest and highest speed of both at the start [m/s]."""
    cruise: float
    """Speed that both prefer [m/s]."""
    passed: float | None
    """x that the robot must pass to be done [m]; where there is none, it must be in its lane, `clearance` off."""
    clearance: float = 2.0
    """Distance from the others' outlines that a lane change must keep in the end [m]."""
    second: CarFollowing | None = None
    """Who follows the person; None for a lane without a second car. It begins as far off as it settles at."""

    @property
    def cars(self) -> tuple[str, ...]:
        """Names of the cars, the robot's first."""
        return CARS if self.second else CARS[:2]

    @property
    def in_the_way(self) -> float:
        """How far beside the person's path the robot's middle is when it begins to be on it: half of both cars, as they
        face each other [m]."""
        across = abs(np.sin(self.heading)) * LENGTH + abs(np.cos(self.heading)) * WIDTH
        return float(across + WIDTH) / 2.0

    def is_done(self, robot: Car, *others: Car) -> bool:
        """Whether the robot is where it should be."""
        if self.passed is not None:
            return bool(robot.x - (LENGTH - WHEELBASE) / 2.0 > self.passed)
        in_lane = abs(robot.y) < 0.5 and abs(robot.yaw) < 0.1
        return bool(in_lane and min(separation(robot, other) for other in others) >= self.clearance)


SCENES = {
    scene.name: scene
    for scene in (
        DrivingScene(
            name="merge", instruction="change to the left lane, before or behind the other cars", heading=0.0,
            robot_y=-LANE, robot_x=(3.0, 9.0), person_start=(0.0, 0.0), speeds=(14.0, 16.0), cruise=15.0, passed=None,
            second=CarFollowing(),
        ),
        DrivingScene(
            name="crossing", instruction="go straight on over the crossing", heading=np.pi / 2.0,
            robot_y=0.0, robot_x=(-28.0, -22.0), person_start=(-28.0, -22.0), speeds=(7.0, 9.0), cruise=8.0, passed=4.0,
        ),
    )
}  # fmt: skip
"""Scenes by name."""


def load_scene(name: str) -> DrivingScene:
    """The scene called `name`. Raises `UnknownName` with the names of all."""
    if name not in SCENES:
        raise UnknownName("scene", name, SCENES)
    return SCENES[name]


def separation(a: Car, b: Car) -> float:
    """Distance between the outlines of two cars [m]; 0 when they touch or overlap.

    Outlines are apart if and only if the direction of some side separates them; then a corner of one is nearest to a
    side of the other.
    """
    first, second = a.corners(), b.corners()
    for corners, others in ((first, second), (second, first)):
        normals = np.roll(corners, -1, axis=0) - corners
        normals = np.stack([normals[:, 1], -normals[:, 0]], axis=1)
        if ((others @ normals.T).min(axis=0) > (corners * normals).sum(axis=1)).any():
            return min(_from_sides(first, second), _from_sides(second, first))
    return 0.0


def _from_sides(points: Float[np.ndarray, "4 2"], corners: Float[np.ndarray, "4 2"]) -> float:
    """Least distance of some points from the sides of an outline [m]."""
    sides = np.roll(corners, -1, axis=0) - corners
    ways = points[:, None] - corners
    along = np.clip((ways * sides).sum(axis=2) / (sides**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(ways - along[..., None] * sides, axis=2).min())


class DrivingWorld:
    """A scene with a robot's car, a person's, and a second one where the scene has it.

    The action is the acceleration [m/s^2] and the steering angle [rad]. An episode breaks off when cars touch. The
    person's theta and the seed of their draws are in the world's memory, not in what it shows.
    """

    def __init__(self, scene: DrivingScene, person: Person, control_hz: int):
        """Raises `InputError` for a rate below 1 Hz."""
        if control_hz < 1:
            raise InputError(f"control_hz = {control_hz}: give at least 1")
        self._scene, self._person, self._dt = scene, person, 1.0 / control_hz
        self._xml = _model_xml(scene)
        self._model = mujoco.MjModel.from_xml_string(self._xml)
        self._data = mujoco.MjData(self._model)
        joints = [f"{ROBOT}_{name}" for name in ("steering", "wheels")]
        self.spec = WorldSpec(
            task=scene.name,
            instruction=scene.instruction,
            robot="car",
            controller="BICYCLE",
            control_hz=control_hz,
            labels={
                **{f"joint_{kind}": tuple(joints) for kind in ("pos", "vel", "effort")},
                **{f"{car}_pos": ("x", "y", "z") for car in scene.cars},
                **{f"{car}_quat": ("w", "x", "y", "z") for car in scene.cars},
                **{f"{car}_speed": ("speed",) for car in scene.cars},
                **{f"{car}_distance": ("distance",) for car in scene.cars[1:]},
                "action": ("acceleration", "steering"),
            },
            action_low=ACTION_LOW.copy(),
            action_high=ACTION_HIGH.copy(),
            stepper="bicycle",
        )
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> Observation:
        """Draw places, speeds and the person."""
        scene = self._scene
        x, along = rng.uniform(*scene.robot_x), rng.uniform(*scene.person_start)
        speeds = rng.uniform(*scene.speeds, 2).tolist()
        robot = Car(x, scene.robot_y, 0.0, speeds[0])
        heading = scene.heading
        person = Car(along * np.cos(heading), along * np.sin(heading), heading, speeds[1])
        self._seed, self._theta = int(rng.integers(2**31)), self._person.draw(rng)
        mujoco.mj_resetData(self._model, self._data)
        cars = [robot, person]
        if scene.second:
            back = LENGTH + scene.second.settled_gap(person.speed)
            cars.append(Car(person.x - back * np.cos(heading), person.y - back * np.sin(heading), heading, speeds[1]))
        self._put(cars, 0.0)
        return self._observe()

    def step(self, action: Float[np.ndarray, "Da"]) -> StepResult:
        """Drive for one control step; what is beyond the limits is clipped.

        Raises `InputError` for an action of another shape or one that is not finite.
        """
        if action.shape != (2,) or not np.isfinite(action).all():
            raise InputError(f"the action is {action}; give a finite acceleration and steering angle")
        applied = np.clip(action, ACTION_LOW, ACTION_HIGH)
        robot, person, *rest = cars = self._cars()
        number = round(self._data.time / self._dt)
        draw = np.random.default_rng([self._seed, number]).random()
        acceleration = self._person.answer(self._theta, robot, person, applied, draw)
        cars = [robot.moved(float(applied[0]), float(applied[1]), self._dt), person.moved(acceleration, 0.0, self._dt)]
        cars += [car.moved(self._following(car, person, robot), 0.0, self._dt) for car in rest]
        self._data.time = (number + 1) * self._dt
        self._put(cars, applied[1])
        touched = min(separation(a, b) for a, b in combinations(cars, 2)) == 0.0
        done = self._scene.is_done(*cars) and not touched
        failure = f"the cars touched after t = {self._data.time:.2f} s" if touched else ""
        return StepResult(self._observe(), -self._dt * (not done), done, bool((applied != action).any()), failure)

    def sim_state(self) -> Float[np.ndarray, "_"]:
        """MuJoCo's mjSTATE_INTEGRATION now."""
        state = np.empty(mujoco.mj_stateSize(self._model, INTEGRATION))
        mujoco.mj_getState(self._model, self._data, state, INTEGRATION)
        return state

    def pictures(self) -> Mapping[str, UInt8[np.ndarray, "H W 3"]]:
        """None: the world has no cameras."""
        return {}

    def get_state(self) -> WorldState:
        """The cars, the person's theta, and the seed of their draws."""
        memory = {"theta": np.array(self._theta, dtype=float), "seed": np.array(float(self._seed))}
        return WorldState(model_xml=self._xml, sim=self.sim_state(), memory=memory)

    def set_state(self, state: WorldState) -> Observation:
        """Go to a state. Raises `SimulationError` when it belongs to another scene."""
        if state.model_xml != self._xml or state.sim.shape != self.sim_state().shape:
            raise SimulationError(f"the state is none of the scene {self._scene.name!r}; make a world of its scene")
        mujoco.mj_setState(self._model, self._data, np.array(state.sim), INTEGRATION)
        self._theta, self._seed = np.array(state.memory["theta"], dtype=float), int(state.memory["seed"])
        return self._observe()

    def _following(self, second: Car, person: Car, robot: Car) -> float:
        """The second car's acceleration: it follows the person, and the robot once its middle is in the lane."""
        assert self._scene.second is not None
        c, s = np.cos(second.yaw), np.sin(second.yaw)
        found = []
        for ahead in (person, robot):
            dx, dy = ahead.x - second.x, ahead.y - second.y
            if dx * c + dy * s > 0.0 and abs(dy * c - dx * s) < LANE / 2.0:
                gap = dx * c + dy * s - LENGTH
                found.append(self._scene.second.acceleration(gap, second.speed, ahead.speed))
        return min(found)

    def _cars(self) -> list[Car]:
        rows = zip(self._data.qpos.reshape(-1, len(JOINTS)), self._data.qvel.reshape(-1, len(JOINTS)), strict=True)
        return [Car(float(at[0]), float(at[1]), float(at[2]), float(rate[4]) * RADIUS) for at, rate in rows]

    def _put(self, cars: Sequence[Car], steering: float) -> None:
        """Set the cars, only the robot steers; wheels have rolled on for a step at their last rate."""
        qpos, qvel = self._data.qpos.reshape(len(cars), -1), self._data.qvel.reshape(len(cars), -1)
        qpos[:, 4] += qvel[:, 4] * self._dt
        for row, car in enumerate(cars):
            angle = steering if row == 0 else 0.0
            qpos[row, :4] = car.x, car.y, car.yaw, angle
            turn = car.speed * np.tan(angle) / WHEELBASE
            qvel[row] = car.speed * np.cos(car.yaw), car.speed * np.sin(car.yaw), turn, 0.0, car.speed / RADIUS

    def _observe(self) -> Observation:
        cars = dict(zip(self._scene.cars, self._cars(), strict=True))
        seen = {"joint_pos": self._data.qpos[3:5].copy(), "joint_vel": self._data.qvel[3:5].copy()}
        seen["joint_effort"] = np.zeros(2)  # kinematic cars know no torques
        for name, car in cars.items():
            seen[f"{name}_pos"] = np.array([car.x, car.y, 0.0])
            seen[f"{name}_quat"] = np.array([np.cos(car.yaw / 2.0), 0.0, 0.0, np.sin(car.yaw / 2.0)])
            seen[f"{name}_speed"] = np.array([car.speed])
        for name in self._scene.cars[1:]:
            seen[f"{name}_distance"] = np.array([separation(cars[ROBOT], cars[name])])
        return seen


def seen_cars(observation: Observation) -> tuple[Car, Car]:
    """The robot's car and the person's, as observed."""
    return _seen(observation, ROBOT), _seen(observation, PERSON)


def seen_second(observation: Observation) -> Car | None:
    """The second car as observed, if there is one."""
    return _seen(observation, SECOND) if f"{SECOND}_pos" in observation else None


def least_distance(observation: Observation) -> float:
    """Distance from the robot's outline to the nearest other one [m]."""
    return min(float(observation[name][0]) for name in (f"{car}_distance" for car in CARS) if name in observation)


def _seen(observation: Observation, name: str) -> Car:
    x, y, _ = observation[f"{name}_pos"].tolist()
    w, _, _, z = observation[f"{name}_quat"].tolist()
    return Car(x, y, 2.0 * float(np.arctan2(z, w)), float(observation[f"{name}_speed"][0]))


def _model_xml(scene: DrivingScene) -> str:
    """The road, two lanes along x or a crossing, and the cars."""
    roads = [_box("road_x", (150.0, 0.0 if scene.passed else -LANE / 2.0, -0.06), (250.0, LANE, 0.05), "0.4 0.4 0.4 1")]
    if scene.passed is None:
        marks = [
            _box(f"mark_{i}", (-90.0 + 10.0 * i, -LANE / 2.0, -0.01), (1.5, 0.08, 0.005), "1 1 1 1") for i in range(50)
        ]
    else:
        roads.append(_box("road_y", (0.0, 0.0, -0.07), (LANE, 100.0, 0.05), "0.4 0.4 0.4 1"))
        marks = [_box("stop_line", (-LANE - 0.3, -LANE / 4.0, -0.01), (0.15, LANE / 4.0, 0.005), "1 1 1 1")]
    colours = "0.16 0.42 0.85 1", "0.92 0.35 0.05 1", "0.55 0.57 0.6 1"
    cars = "".join(_car_xml(name, colour) for name, colour in zip(scene.cars, colours, strict=False))
    return (
        f'<mujoco model="{scene.name}"><option gravity="0 0 0"/>'
        '<default><geom contype="0" conaffinity="0" group="1"/></default>'
        f'<worldbody><light pos="0 0 50" directional="true"/>{"".join(roads + marks)}{cars}</worldbody></mujoco>'
    )


def _car_xml(name: str, colour: str) -> str:
    ahead = WHEELBASE / 2.0
    wheels = "".join(
        f'<geom type="cylinder" size="{RADIUS} 0.1" pos="0 {side * 0.8} 0" quat="0.7071 0.7071 0 0" '
        'rgba="0.1 0.1 0.1 1" mass="10"/>'
        for side in (-1, 1)
    )
    return (
        f'<body name="{name}"><joint name="{name}_x" type="slide" axis="1 0 0"/>'
        f'<joint name="{name}_y" type="slide" axis="0 1 0"/><joint name="{name}_yaw" type="hinge" axis="0 0 1"/>'
        + _box(f"{name}_hull", (ahead, 0.0, 0.6), (LENGTH / 2.0, WIDTH / 2.0, 0.3), colour)
        + _box(f"{name}_cabin", (ahead - 0.2, 0.0, 1.15), (1.1, 0.75, 0.25), "0.15 0.17 0.2 1")
        + f'<body name="{name}_front" pos="{WHEELBASE} 0 {RADIUS}">'
        f'<joint name="{name}_steering" type="hinge" axis="0 0 1"/>{wheels}</body>'
        f'<body name="{name}_rear" pos="0 0 {RADIUS}">'
        f'<joint name="{name}_wheels" type="hinge" axis="0 1 0"/>{wheels}</body></body>'
    )


def _box(name: str, at: tuple[float, ...], half: tuple[float, ...], colour: str) -> str:
    pos, size = (" ".join(f"{x:g}" for x in each) for each in (at, half))
    return f'<geom name="{name}" type="box" pos="{pos}" size="{size}" rgba="{colour}" mass="100"/>'
