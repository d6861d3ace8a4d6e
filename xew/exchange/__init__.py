"""Other people's data sets in and out: RoboTwin's HDF5 episodes are imported, ours are exported for LeRobot.

The commands are `python -m xew.exchange.robotwin` and `python -m xew.exchange.lerobot`; both keep to the contract of
`xew.episode` and train nothing.
"""

__all__ = ["hdf5", "lerobot", "robotwin"]
