"""Tasks: robosuite environments by the name that recipes use, and what the robot is told to do."""

TASKS: dict[str, str] = {
    "Lift": "lift the red cube off the table",
}
"""Name of the robosuite environment to the instruction, LeRobot's task string."""
