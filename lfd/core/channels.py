"""The table of channels: what is measured, in which unit and frame, and where each format keeps it.

MCAP topics, LeRobot features and Rerun paths are derived from the rows below and written nowhere else.
A channel's numbers at one time are a vector; the names of its components (joints, axes) come from the
world and are stored beside the data as `labels`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol, Self

from lfd.core.errors import RecipeError, UnknownName

JOINT_STATE = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
ARRAY = "std_msgs/msg/Float64MultiArray"
IMAGE = "sensor_msgs/msg/CompressedImage"

STATE = "observation.state"
ENVIRONMENT_STATE = "observation.environment_state"

XYZ = ("x", "y", "z")
WXYZ = ("w", "x", "y", "z")


class SupportsDifference(Protocol):
    """What can be subtracted from its like: arrays."""

    def __sub__(self, other: Self, /) -> Self: ...


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One row of the table."""

    name: str
    """Key in an observation; `{object}` stands for the name of an object of the task, `{arm}` for one of two arms,
    `{camera}` for a camera."""
    meaning: str
    """What the numbers are."""
    unit: str
    """Unit of the numbers; `controller` means the input range of the robot's controller."""
    frame: str
    """Frame in which they are expressed."""
    topic: str
    """MCAP topic."""
    schema: str
    """ROS 2 message type on that topic."""
    field: str
    """Field of the message."""
    feature: str | None
    """LeRobot feature that a dataset puts it into when its recipe lists the channel."""
    path: str
    """Rerun entity of its plot."""

    def of(self, name: str) -> "Channel":
        """This row with its blank, such as `{object}`, filled in for the channel called `name`."""
        blank, _, suffix = self.name.rpartition("}")
        part = name.removesuffix(suffix)
        filled = {key: value.replace(f"{blank}}}", part) for key, value in vars(self).items() if value}
        return Channel(**{**vars(self), **filled})


def _row(
    name: str, meaning: str, unit: str, frame: str, topic: str, schema: str, field: str, feature: str | None, path: str
) -> Channel:
    return Channel(
        name=name, meaning=meaning, unit=unit, frame=frame, topic=topic, schema=schema, field=field,
        feature=feature, path=path,
    )  # fmt: skip


# fmt: off
CHANNELS: dict[str, Channel] = {row.name: row for row in (
    _row("joint_pos", "arm joint positions", "rad", "joint", "/joint_states", JOINT_STATE, "position", STATE, "plots/joints/position"),
    _row("joint_vel", "arm joint velocities", "rad/s", "joint", "/joint_states", JOINT_STATE, "velocity", STATE, "plots/joints/velocity"),
    _row("joint_effort", "torques of the arm's actuators", "N m", "joint", "/joint_states", JOINT_STATE, "effort", STATE, "plots/joints/effort"),
    _row("gripper_pos", "finger joint positions", "m", "joint", "/joint_states", JOINT_STATE, "position", STATE, "plots/gripper/position"),
    _row("gripper_vel", "finger joint velocities", "m/s", "joint", "/joint_states", JOINT_STATE, "velocity", STATE, "plots/gripper/velocity"),
    _row("gripper_effort", "forces of the gripper's actuators", "N", "joint", "/joint_states", JOINT_STATE, "effort", STATE, "plots/gripper/effort"),
    _row("ee_pos", "position of the grip site", "m", "world", "/ee_pose", POSE, "position", STATE, "plots/ee/position"),
    _row("ee_quat", "orientation of the grip site, wxyz", "1", "world", "/ee_pose", POSE, "orientation", STATE, "plots/ee/orientation"),
    _row("{arm}_ee_pos", "position of one of two grip sites", "m", "world", "/{arm}_ee_pose", POSE, "position", STATE, "plots/{arm}_ee/position"),
    _row("{arm}_ee_quat", "orientation of one of two grip sites, wxyz", "1", "world", "/{arm}_ee_pose", POSE, "orientation", STATE, "plots/{arm}_ee/orientation"),
    _row("{object}_qpos", "positions of an object's own joints", "rad or m", "joint", "/objects/{object}/joints", ARRAY, "data", ENVIRONMENT_STATE, "plots/objects/{object}/joints"),
    _row("{object}_point", "position of a point of an object, or of the nearest and the mean dirt that is left", "m", "world", "/objects/{object}/point", ARRAY, "data", ENVIRONMENT_STATE, "plots/objects/{object}/point"),
    _row("{object}_pos", "position of an object's body", "m", "world", "/objects/{object}/pose", POSE, "position", ENVIRONMENT_STATE, "plots/objects/{object}/position"),
    _row("{object}_quat", "orientation of an object's body, wxyz", "1", "world", "/objects/{object}/pose", POSE, "orientation", ENVIRONMENT_STATE, "plots/objects/{object}/orientation"),
    _row("{object}_speed", "speed of an object along its heading", "m/s", "object", "/objects/{object}/speed", ARRAY, "data", ENVIRONMENT_STATE, "plots/objects/{object}/speed"),
    _row("{object}_distance", "distance between the surfaces of an object and of the robot", "m", "world", "/objects/{object}/distance", ARRAY, "data", ENVIRONMENT_STATE, "plots/objects/{object}/distance"),
    _row("{camera}_picture", "what a camera sees, RGB", "1/255", "camera", "/cameras/{camera}", IMAGE, "data", "observation.images.{camera}", "cameras/{camera}"),
    _row("sim_state", "MuJoCo's mjSTATE_INTEGRATION", "mixed", "model", "/sim/state", ARRAY, "data", None, ""),
    _row("action", "action that was applied", "controller", "controller", "/action", ARRAY, "data", "action", "plots/action/applied"),
    _row("expert_action", "action that the expert proposed", "controller", "controller", "/expert/action", ARRAY, "data", "expert_action", "plots/action/expert"),
    _row("policy_action", "action that the learner proposed", "controller", "controller", "/policy/action", ARRAY, "data", None, "plots/action/policy"),
    _row("gate", "what a gate measured when it decided who acts", "mixed", "task", "/gate", ARRAY, "data", None, "plots/gate"),
    _row("teleop_axes", "what a person's device said, before gains", "1", "device", "/teleop/axes", ARRAY, "data", None, "plots/teleop/axes"),
    _row("belief", "probability of each intent that a person may have", "1", "task", "/belief", ARRAY, "data", None, "plots/belief"),
    _row("belief_entropy", "entropy of the belief about a person's intent", "nat", "task", "/belief/entropy", ARRAY, "data", None, "plots/belief_entropy"),
    _row("push", "force and torque of a person on the arm, at the pushed body's centre", "N and N m", "world", "/push", ARRAY, "data", None, "plots/push"),
    _row("external_torque", "what the arm takes for the torque of a push", "N m", "joint", "/external_torque", ARRAY, "data", None, "plots/external_torque"),
    _row("weights", "reward for each unit of a feature's count", "mixed", "task", "/reward/weights", ARRAY, "data", None, "plots/weights"),
    _row("{plan}_path", "the gripper's way by a plan: planned, deformed by a push, new", "m", "world", "/plans/{plan}", ARRAY, "data", None, "world/plans/{plan}"),
    _row("pace", "how late the step began, in a recording in real time", "s", "clock", "/pace", ARRAY, "data", None, "plots/pace"),
    _row("reward", "reward of the step", "1", "task", "/step", ARRAY, "reward", "next.reward", "plots/step/reward"),
    _row("success", "success after the step", "bool", "task", "/step", ARRAY, "success", "next.success", "plots/step/success"),
    _row("done", "the episode ended with the step", "bool", "task", "/step", ARRAY, "done", "next.done", "plots/step/done"),
    _row("intervention", "a person or an expert overruled the policy", "bool", "task", "/step", ARRAY, "intervention", "intervention", "plots/step/intervention"),
)}
# fmt: on


MINUS = " - "
"""Between two channels: `cube_pos - ee_pos` is their difference, as datasets and policies may take it."""


def channel(name: str) -> Channel:
    """The row of the channel called `name`, objects filled in: `channel("cube_pos").topic` is `/objects/cube/pose`.

    A difference has the row of its first channel, whose unit and frame the second must share. Raises `UnknownName` for
    a name that no row matches, `RecipeError` for a difference of unlike things.
    """
    first, *others = operands(name)
    if others:
        rows = [channel(each) for each in (first, *others)]
        if len(rows) != 2 or len({(row.unit, row.frame) for row in rows}) > 1:
            told = ", ".join(f"{row.name} [{row.unit}, {row.frame}]" for row in rows)
            raise RecipeError(f"{name!r} is no difference of two channels in the same unit and frame: {told}")
        return replace(rows[0], name=name, meaning=f"{rows[0].meaning}, from {rows[1].name}")
    if name in CHANNELS and "{" not in name:
        return CHANNELS[name]
    for template, row in CHANNELS.items():
        blank, _, suffix = template.partition("}")
        if suffix and blank.startswith("{") and name.endswith(suffix) and len(name) > len(suffix):
            return row.of(name)
    raise UnknownName("channel", name, CHANNELS)


def signal_of(topic: str) -> str | None:
    """The channel of `Decision.signals` that a topic holds; None for other topics."""
    for row in CHANNELS.values():
        if row.schema != ARRAY or row.feature is not None or row.name == "sim_state":
            continue
        before, blank, _ = row.topic.partition("{")
        if not blank and topic == row.topic:
            return row.name
        if blank and topic.startswith(before) and "/" not in topic.removeprefix(before):
            return f"{topic.removeprefix(before)}{row.name.partition('}')[2]}"
    return None


def operands(name: str) -> tuple[str, ...]:
    """The channels that a name is read from: itself, or the two of a difference."""
    return tuple(name.split(MINUS))


def observed[Rows: SupportsDifference](observation: Mapping[str, Rows], name: str) -> Rows:
    """A channel of an observation, or the difference of two. Raises `KeyError` for one that is not there."""
    first, *others = operands(name)
    return observation[first] - observation[others[0]] if others else observation[first]
