"""Robots of a user's own: from the path of a URDF to a `RobotSpec`, with what was left open found or refused.

They are kept beside the data that were made with them, so that a data set can always be read again.
"""

__all__ = ["draft", "infer", "own", "placement", "trials"]
