"""Recordings to LeRobot datasets, and the proof that nothing was lost on the way."""
