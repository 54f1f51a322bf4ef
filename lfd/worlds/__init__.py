"""Where behaviour happens: robots, tasks, the robosuite world and the one closed loop."""
