"""LeRobot datasets to batches."""
