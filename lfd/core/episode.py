"""An episode: one demonstration or rollout, xi = ((x_0, u_0), (x_1, u_1), ..., x_T).

T actions stand between T1 = T + 1 observations; row t of `actions` was chosen in row t of the observations, row t
of `rewards` and `successes` was measured after it. Arrays are float64 and read-only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lfd.core.errors import EpisodeError


@dataclass(frozen=True, kw_only=True)
class EpisodeMetadata:
    """Where an episode comes from."""

    task: str
    """Name of the task, for example Lift."""
    instruction: str
    """What the robot should do, in words."""
    robot: str
    """Name of the robot config."""
    controller: str
    """Controller of the arm, for example OSC_POSE."""
    policy: str
    """Name of what acted."""
    control_hz: int
    """Control steps a second [Hz]."""
    stage: str
    """What the episode was made for: record or eval. Part of its random seed."""
    seed: int
    """Seed of the run."""
    index: int
    """Number of the attempt within the run; (stage, seed, index) decide everything that was drawn."""
    stepper: str
    """What computed the control steps; exact replay needs the same."""
    started: str
    """Wall time of the first step, ISO 8601."""
    versions: Mapping[str, str]
    """Versions of the libraries and of the Python that made it."""
    recipe: Mapping[str, Any]
    """The recipe as it was used."""
    recovered: str = ""
    """How much of the episode was saved, where its recording was cut off; else empty."""


@dataclass(frozen=True)
class Signal:
    """What was put on record beside the usual at some of the steps: what a gate measured, a push, a belief."""

    times: Float[np.ndarray, "M"]
    """Since the first observation [s]."""
    values: Float[np.ndarray, "M D"]
    names: tuple[str, ...]
    """Of the components."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """A demonstration or rollout of T control steps, validated when made.

    Raises `EpisodeError` when it is empty, when lengths differ, when a number is not finite or when time
    does not increase.
    """

    times: Float[np.ndarray, "T1"]
    """Time of each observation since the first [s]."""
    observations: Mapping[str, Float[np.ndarray, "T1 _"]]
    """Channel name to its values, in the channel's unit and frame (`lfd.core.channels`)."""
    actions: Float[np.ndarray, "T Da"]
    """Actions applied, in the controller's input range."""
    rewards: Float[np.ndarray, "T"]
    """Reward of each step."""
    successes: Bool[np.ndarray, "T"]
    """Whether the task was solved after each step."""
    interventions: Bool[np.ndarray, "T"]
    """Whether a person or expert overruled the policy in the step."""
    expert_actions: Float[np.ndarray, "T Da"] | None = None
    """What the expert proposed; a row of NaN where it was not asked, and none where it never was."""
    sim_states: Float[np.ndarray, "T1 _"] | None = None
    """MuJoCo's integration state at each observation."""
    pictures: Mapping[str, tuple[bytes, ...]] = field(default_factory=dict)
    """Camera to its picture at each observation, as PNG."""
    labels: Mapping[str, tuple[str, ...]]
    """Names of the components of each observation channel and of `action`."""
    metadata: EpisodeMetadata
    model_xml: str = ""
    """The MuJoCo model, mesh paths starting with `robosuite/`."""
    signals: Mapping[str, Signal] = field(default_factory=dict)
    """What else belongs on record (`Decision.signals`), by channel."""
    declared: bool | None = None
    """Whether the recording says that it ended in success, where a person may have had the last word."""
    start_memory: Mapping[str, np.ndarray] | None = None
    """What the controllers remembered at the first observation; exact replay starts from it."""

    def __post_init__(self) -> None:
        steps = len(self.actions)
        if steps == 0:
            raise EpisodeError("an episode needs at least one step, this one has none")
        rows: dict[str, tuple[np.ndarray, int]] = {
            "time": (self.times, steps + 1),
            "action": (self.actions, steps),
            "reward": (self.rewards, steps),
            "success": (self.successes, steps),
            "intervention": (self.interventions, steps),
        }
        rows |= {name: (values, steps + 1) for name, values in self.observations.items()}
        if self.expert_actions is not None:
            rows["expert_action"] = (np.where(self.labelled[:, None], self.expert_actions, 0.0), steps)
            self.expert_actions.flags.writeable = False
        if self.sim_states is not None:
            rows["sim_state"] = (self.sim_states, steps + 1)
        for name, (values, length) in rows.items():
            if len(values) != length:
                raise EpisodeError(f"channel {name!r} has {len(values)} rows, {steps} actions need {length}")
            finite = np.isfinite(values).reshape(length, -1).all(axis=1)
            if not finite.all():
                raise EpisodeError(f"channel {name!r} is not finite at step {int(np.argmin(finite))}")
            values.flags.writeable = False
        for name, pictures in self.pictures.items():
            if len(pictures) != steps + 1:
                raise EpisodeError(f"camera {name!r} has {len(pictures)} pictures, {steps} actions need {steps + 1}")
        if not (np.diff(self.times) > 0).all():
            raise EpisodeError(f"time does not increase at step {int(np.argmin(np.diff(self.times) > 0)) + 1}")
        for name, names in self.labels.items():
            values = self.actions if name == "action" else self.observations.get(name)
            if values is None or values.shape[1] != len(names):
                size = "is missing" if values is None else f"has {values.shape[1]} components"
                raise EpisodeError(f"channel {name!r} {size}, its labels name {len(names)}: {', '.join(names)}")
        object.__setattr__(self, "observations", MappingProxyType(dict(self.observations)))

    def __len__(self) -> int:
        """Number of control steps T."""
        return len(self.actions)

    @property
    def labelled(self) -> Bool[np.ndarray, "T"]:
        """In which steps the expert said what it would do."""
        if self.expert_actions is None:
            return np.zeros(len(self), dtype=bool)
        return ~np.asarray(np.isnan(self.expert_actions).all(axis=1))

    @property
    def success(self) -> bool:
        """Whether it ended in success: by what was declared, else by the simulation after the last step."""
        return bool(self.successes[-1] if self.declared is None else self.declared)
