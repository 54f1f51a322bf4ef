"""The files of a LeRobot v3 dataset: written, read, their statistics and videos."""
