"""Demonstrations in HDF5, robosuite's and robomimic's: read safely, shown to the simulator, written."""
