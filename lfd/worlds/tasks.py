"""Tasks: robosuite environments by the name that recipes use, and what the robot is told to do."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from lfd.core.errors import UnknownName


@dataclass(frozen=True)
class Task:
    """A table-top task of robosuite."""

    name: str
    """Name of the robosuite environment."""
    instruction: str
    """What the robot is told to do, LeRobot's task string."""
    arms: int = 1
    """Arms that the task is for."""
    bodies: Mapping[str, str] = field(default_factory=dict)
    """Bodies to observe beside the roots of the objects, or in their place: name to body in the model."""
    points: Mapping[str, str] = field(default_factory=dict)
    """Points of objects: name in the observation to site in the model."""


_NUTS = "put each nut on its peg"
_BINS = "put each object into its bin"
TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        Task("Lift", "lift the red cube off the table"),
        Task("Stack", "stack the red cube on the green cube"),
        Task("NutAssembly", _NUTS),
        Task("NutAssemblySingle", "put the nut on its peg"),
        Task("NutAssemblySquare", "put the square nut on the square peg", bodies={"peg": "peg1"}),
        Task("NutAssemblyRound", "put the round nut on the round peg"),
        Task("PickPlace", _BINS),
        Task("PickPlaceSingle", "put the object into its bin"),
        Task("PickPlaceMilk", "put the milk into its bin"),
        Task("PickPlaceBread", "put the bread into its bin"),
        Task("PickPlaceCereal", "put the cereal into its bin"),
        Task("PickPlaceCan", "put the can into its bin"),
        Task(
            "Door",
            "turn the handle and open the door",
            bodies={"Door": "Door_door"},
            points={"handle": "Door_handle"},
        ),
        Task("Wipe", "wipe the dirt off the table"),
        Task(
            "ToolHang",
            "put the hook into its stand and hang the tool on it",
            points={"tip": "frame_tip_site", "hook": "frame_hang_site", "ring": "tool_hole1_center"},
        ),
        Task(
            "TwoArmLift",
            "lift the pot by its two handles",
            2,
            points={"handle0": "pot_handle0", "handle1": "pot_handle1"},
        ),
        Task("TwoArmPegInHole", "put the peg into the hole", 2, bodies={"hole": "hole_main", "peg": "peg_main"}),
        Task("TwoArmHandover", "hand the hammer over", 2),
        Task("TwoArmTransport", "bring the hammer to the other table", 2),
    )
}
"""Tasks by name."""


def load_task(name: str) -> Task:
    """The task called `name`.

    Raises `UnknownName` with the names of all tasks.
    """
    if name not in TASKS:
        raise UnknownName("task", name, TASKS)
    return TASKS[name]
