"""Users' robots: from the path of a URDF to a `RobotSpec`, with inferred entries for missing ones.

A data set holds copies of the users' robots that made it.
"""

__all__ = ["draft", "infer", "own", "placement", "trials"]
