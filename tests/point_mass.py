"""A small real world: a point in the plane that is to be brought to the origin, with an expert and learners."""

from collections.abc import Mapping

import numpy as np

from lfd.core.protocols import Decision, Observation, StepResult, WorldSpec, WorldState

STEP = 0.1
SPEC = WorldSpec(
    task="Point",
    instruction="go to the origin",
    robot="point",
    controller="VELOCITY",
    control_hz=10,
    labels={"position": ("x", "y"), "action": ("x", "y")},
    action_low=-np.ones(2),
    action_high=np.ones(2),
    stepper="plain",
)


class PointMass:
    """x' = x + 0.1 u, u in [-1, 1]^2; solved within 0.1 of the origin."""

    spec = SPEC

    def reset(self, rng: np.random.Generator) -> Observation:
        self._x = rng.uniform(-1.0, 1.0, 2)
        return self._observe()

    def step(self, action: np.ndarray) -> StepResult:
        self._x = self._x + STEP * np.clip(action, -1.0, 1.0)
        near = float(np.linalg.norm(self._x))
        return StepResult(self._observe(), -near, near < 0.1, bool((np.abs(action) > 1.0).any()))

    def sim_state(self) -> np.ndarray:
        return self._x.copy()

    def pictures(self) -> Mapping[str, np.ndarray]:
        return {}

    def get_state(self) -> WorldState:
        return WorldState(model_xml="", sim=self._x.copy(), memory={})

    def set_state(self, state: WorldState) -> Observation:
        self._x = state.sim.copy()
        return self._observe()

    def _observe(self) -> Observation:
        return {"position": self._x.copy()}


class PointExpert:
    """Goes straight to the origin."""

    name = "point_expert"

    def __init__(self) -> None:
        self.asked = 0

    def reset(self, rng: np.random.Generator) -> None: ...

    def act(self, observation: Observation) -> Decision:
        self.asked += 1
        action = np.clip(-observation["position"] / STEP, -1.0, 1.0)
        return Decision(action, expert_action=action)


class PointLearner:
    """Goes to the origin with a gain and a bias, and with noise from the generator of its episode."""

    name = "point_learner"

    def __init__(self, gain: float = 0.5, bias: tuple[float, float] = (0.0, 0.0), noise: float = 0.0):
        self._gain, self._bias, self._noise = gain, np.array(bias), noise

    def reset(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def act(self, observation: Observation) -> Decision:
        meant = -self._gain * observation["position"] / STEP + self._bias
        return Decision(np.clip(meant + self._noise * self._rng.normal(size=2), -1.0, 1.0))
