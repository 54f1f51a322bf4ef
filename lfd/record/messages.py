"""Which messages a control step has, and which numbers of the step each of them takes.

The numbers of a step stand in one flat vector, channel after channel; a message names its numbers by their places in
it. Topics and types come from the table of channels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Int

from lfd.core.channels import ARRAY, CHANNELS, POSE, channel
from lfd.core.rotations import xyzw_from_wxyz
from lfd.record.columns import array_pack, joint_state_pack, pose_pack, transforms_pack
from lfd.record.layouts import BlockMessage, Layout, Pack, StepBlock

STEP = "step"
"""Key of the numbers that belong to the step itself."""
STEP_LABELS = ("reward", "success", "done", "intervention")
SIM_STATE = "sim_state"
SIM_LABELS = ("mjSTATE_INTEGRATION",)
JOINT_KINDS = ("joint", "gripper")
Labels = Mapping[str, tuple[str, ...]]
Places = Mapping[str, Int[np.ndarray, "_"]]
"""Channel to the places of its numbers in the flat vector of a step."""


@dataclass(frozen=True, kw_only=True)
class StepMessage:
    """A message that every step has."""

    topic: str
    schema: str
    about: Mapping[str, str]
    """Unit and frame."""
    places: Int[np.ndarray, "F"]
    """Places of its numbers in the flat vector of the step, in the order in which they are packed."""
    pack: Pack

    @cached_property
    def layout(self) -> Layout:
        return Layout.of(self.pack, len(self.places))


@dataclass(frozen=True, kw_only=True, eq=False)
class StepMessages:
    """All messages of a step."""

    early: Sequence[StepMessage]
    """Those at the time of the decision."""
    late: Sequence[StepMessage]
    """Those at the time of the observation after it."""

    size: int
    """Numbers of the flat vector."""

    @property
    def all(self) -> list[StepMessage]:
        return [*self.early, *self.late]

    @cached_property
    def places(self) -> Int[np.ndarray, "F"]:
        """Places of all their numbers, message after message, in the flat vector of the step."""
        return np.concatenate([message.places for message in self.all])

    @lru_cache(maxsize=4)  # noqa: B019  one of these lives as long as its world's kind
    def block(self, numbers: tuple[int, ...]) -> StepBlock:
        """Their records in a file where their topics have these numbers."""
        late = [False] * len(self.early) + [True] * len(self.late)
        messages = zip(numbers, self.all, late, strict=True)
        return StepBlock([BlockMessage(number, m.layout, is_late) for number, m, is_late in messages])


Components = tuple[tuple[str, tuple[str, ...]], ...]
"""Labels that can be a key."""


@lru_cache(maxsize=16)
def step_messages(labels: Components, sim_size: int, *, has_expert: bool, signals: Components) -> StepMessages:
    """The messages of a step, whose flat vector has the observation, the simulation's state, the step's own numbers,
    the action, the expert's action where there is one, and the signals.

    The same for all episodes of a world, hence made once.
    """
    names = dict(labels)
    at = _places(
        {name: len(components) for name, components in labels if name != "action"}
        | {SIM_STATE: sim_size, STEP: len(STEP_LABELS), "action": len(names["action"])}
        | ({"expert_action": len(names["action"])} if has_expert else {})
        | {name: len(components) for name, components in signals}
    )
    return StepMessages(
        size=sum(map(len, at.values())),
        early=_decision_messages(names, at, has_expert=has_expert, signals=dict(signals)),
        late=[_step_message(at), *_observation_messages(names, at)],
    )


def _places(sizes: Mapping[str, int]) -> Places:
    """Places of channels that follow one another in a flat vector."""
    ends = np.cumsum(list(sizes.values()))
    return {name: np.arange(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def _observation_messages(labels: Labels, at: Places) -> list[StepMessage]:
    """The messages of an observation, and of the simulation's state."""
    found, bodies = [_joint_state(labels, at)], {}
    for name, components in labels.items():
        row = channel(name)
        if row.schema == POSE and row.field == "position":
            body = name.removesuffix("_pos")
            bodies[body] = np.concatenate([at[name], xyzw_from_wxyz(at[f"{body}_quat"])])
            found.append(_message(row.topic, POSE, row.unit, row.frame, bodies[body], pose_pack))
        elif row.schema == ARRAY and name != "action":
            found.append(_array_message(name, components, at[name]))
    found.append(_transforms(bodies))
    found.append(_array_message(SIM_STATE, SIM_LABELS, at[SIM_STATE]))
    return found


def _decision_messages(labels: Labels, at: Places, *, has_expert: bool, signals: Labels) -> list[StepMessage]:
    """The messages of a decision."""
    names = labels["action"]
    found = [_array_message("action", names, at["action"])]
    if grips := [place for place, name in enumerate(names) if name.endswith("gripper")]:
        packed = array_pack([names[place] for place in grips])
        places = at["action"][grips]
        found.append(_message("/gripper/command", ARRAY, "controller", "controller", places, packed))
    if has_expert:
        found.append(_array_message("expert_action", names, at["expert_action"]))
    return found + [_array_message(name, components, at[name]) for name, components in signals.items()]


def _step_message(at: Places) -> StepMessage:
    """The message of what followed a decision: reward, success, done, intervention."""
    row = CHANNELS["reward"]
    return _message(row.topic, row.schema, row.unit, row.frame, at[STEP], array_pack(STEP_LABELS))


def _array_message(name: str, components: Sequence[str], places: Int[np.ndarray, "F"]) -> StepMessage:
    """The message of a channel that is a labelled array."""
    row = channel(name)
    return _message(row.topic, ARRAY, row.unit, row.frame, places, array_pack(components))


def _message(topic: str, schema: str, unit: str, frame: str, places: Int[np.ndarray, "F"], pack: Pack) -> StepMessage:
    return StepMessage(topic=topic, schema=schema, about={"unit": unit, "frame": frame}, places=places, pack=pack)


def _joint_state(labels: Labels, at: Places) -> StepMessage:
    kinds = [joints for joints in JOINT_KINDS if f"{joints}_pos" in labels]  # not every arm has a gripper
    names = tuple(name for joints in kinds for name in labels[f"{joints}_pos"])
    places = np.concatenate([at[f"{joints}_{what}"] for what in ("pos", "vel", "effort") for joints in kinds])
    row = CHANNELS["joint_pos"]
    return _message(row.topic, row.schema, row.unit, row.frame, places, joint_state_pack(names))


def _transforms(bodies: Mapping[str, Int[np.ndarray, "7"]]) -> StepMessage:
    places = np.concatenate([np.empty(0, dtype=int), *bodies.values()])
    return _message("/tf", "tf2_msgs/msg/TFMessage", "m", "world", places, transforms_pack(list(bodies)))
