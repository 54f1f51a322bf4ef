"""Rollouts to MCAP and back: one file an episode, which Foxglove and Rerun open as it is."""
