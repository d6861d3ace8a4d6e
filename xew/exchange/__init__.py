"""Import and export of data sets: RoboTwin's HDF5 episodes are imported, xew's episodes are exported for LeRobot.

The commands are `python -m xew.exchange.robotwin` and `python -m xew.exchange.lerobot`.
"""

__all__ = ["hdf5", "lerobot", "robotwin"]
