"""What everything that acts, is acted on, watches and reports progress has to offer."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

Observation = Mapping[str, Float[np.ndarray, "_"]]
"""Channel name to a vector, in the units and frames of `lfd.core.channels`."""


@dataclass(frozen=True, kw_only=True)
class WorldSpec:
    """What is fixed about a world while it lives."""

    task: str
    instruction: str
    robot: str
    controller: str
    control_hz: int
    """Control steps a second [Hz]."""
    labels: Mapping[str, tuple[str, ...]]
    """Component names of every observation channel and of `action`."""
    action_low: Float[np.ndarray, "Da"]
    """Lowest action that the controller takes; lower ones are clipped."""
    action_high: Float[np.ndarray, "Da"]
    """Highest action that the controller takes; higher ones are clipped."""
    stepper: str
    """What computes a control step."""
    cameras: tuple[str, ...] = ()
    """Names of the cameras whose pictures the world takes."""


@dataclass(frozen=True, kw_only=True)
class WorldState:
    """Everything that decides a world's future, given the actions."""

    model_xml: str
    """The model that `sim` belongs to."""
    sim: Float[np.ndarray, "_"]
    """MuJoCo's mjSTATE_INTEGRATION."""
    memory: Mapping[str, np.ndarray]
    """What the controllers and the gripper remember."""


@dataclass(frozen=True)
class StepResult:
    """What a world answers to an action."""

    observation: Observation
    reward: float
    success: bool
    clipped: bool = False
    """Whether the action was beyond the controller's limits."""
    failure: str = ""
    """Why the episode cannot go on; empty as long as it can."""


@runtime_checkable
class World(Protocol):
    """Where behaviour happens."""

    @property
    def spec(self) -> WorldSpec: ...

    def reset(self, rng: np.random.Generator) -> Observation:
        """Draw a start state; the same generator state gives the same start, bit for bit."""
        ...

    def step(self, action: Float[np.ndarray, "Da"]) -> StepResult:
        """Apply an action for one control step."""
        ...

    def sim_state(self) -> Float[np.ndarray, "_"]:
        """MuJoCo's mjSTATE_INTEGRATION now."""
        ...

    def pictures(self) -> Mapping[str, UInt8[np.ndarray, "H W 3"]]:
        """What the world's cameras see now, RGB; none unless they were asked for."""
        ...

    def get_state(self) -> WorldState: ...

    def set_state(self, state: WorldState) -> Observation:
        """Go to a state: the same actions then give the same states, bit for bit."""
        ...


class Verdict(StrEnum):
    """A person's word that ends an episode."""

    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"
    """Not even a failure to keep."""


@dataclass(frozen=True)
class Decision:
    """What a policy chose, and what is known about the choice."""

    action: Float[np.ndarray, "Da"]
    """The action to apply."""
    expert_action: Float[np.ndarray, "Da"] | None = None
    """The expert's proposal in the same state, where one was asked; it may differ from `action`."""
    intervention: bool = False
    """Whether a person or expert overruled the policy."""
    verdict: Verdict | None = None
    """A word that ends the episode after this step."""
    signals: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """What else belongs on record: channel name (`lfd.core.channels`) to its components."""


@runtime_checkable
class Policy(Protocol):
    """Anything that acts: u_t = pi(x_t)."""

    name: str

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode; `rng` is the source of all the policy's randomness in it."""
        ...

    def act(self, observation: Observation) -> Decision: ...


@runtime_checkable
class BatchPolicy(Protocol):
    """A policy that acts in many worlds and is asked once for all of them."""

    name: str

    def reset(self, place: int, rng: np.random.Generator) -> None:
        """Begin an episode in the world number `place`."""
        ...

    def act(self, places: Sequence[int], observations: Sequence[Observation]) -> Sequence[Decision]:
        """A decision for each of some worlds. It depends on what that world shows, not on the others."""
        ...


@dataclass(frozen=True)
class Transition:
    """One step of a rollout: x_t, the decision in it, and what followed."""

    step: int
    observation: Observation
    decision: Decision
    result: StepResult
    done: bool


@runtime_checkable
class Observer(Protocol):
    """Watches a rollout: records, counts, streams."""

    def begin(self, world: World, observation: Observation) -> None: ...

    def step(self, world: World, transition: Transition) -> None: ...

    def end(self, success: bool) -> None:
        """The episode is over."""
        ...

    def abort(self) -> None:
        """The episode was broken off by an error or by Ctrl-C: leave nothing half-done behind."""
        ...


Observers = Callable[[int], Sequence[Observer]]
"""From the number of an episode to what else watches it."""


def unwatched(index: int) -> Sequence[Observer]:
    """Nothing else watches an episode."""
    del index
    return ()


@runtime_checkable
class UnitMap(Protocol):
    """Runs a function over units of work on other machines (`lfd.cluster`)."""

    @property
    def cpus(self) -> int:
        """Units that run at a time."""
        ...

    def __call__[Shared, Unit, Result](
        self, function: Callable[[Shared, Unit], Result], shared: Shared, units: Sequence[Unit]
    ) -> Iterator[tuple[int, Result]]:
        """Results of `function(shared, unit)` as they finish, each with the index of its unit."""
        ...


@runtime_checkable
class Bar(Protocol):
    """A running progress bar."""

    def advance(self, amount: int = 1, note: str = "") -> None: ...


@runtime_checkable
class Progress(Protocol):
    """Opens a progress bar for a long stage."""

    def __call__(self, label: str, total: int) -> AbstractContextManager[Bar]: ...


class _Silence:
    def advance(self, amount: int = 1, note: str = "") -> None:
        del amount, note


def silent(label: str, total: int) -> AbstractContextManager[Bar]:
    """Progress that shows nothing."""
    del label, total
    return nullcontext(_Silence())


def batches(count: int, cpus: int) -> list[range]:
    """The numbers below `count` in units of work: some for each of `cpus`, so that all end at about the same time."""
    size = max(1, count // (4 * max(cpus, 1)))
    return [range(begin, min(begin + size, count)) for begin in range(0, count, size)]
