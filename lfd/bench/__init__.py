"""The published comparisons, one file a suite: each measures all sides in the same run."""
