"""Episodes to Rerun, and the check that a recording can be executed again exactly."""
