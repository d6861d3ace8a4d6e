"""Geometry: triangle meshes, poses with their transforms, and the pinhole camera.

Functions of arrays in meters and radians, independent of robots, tasks and devices.
"""

__all__ = ["camera", "meshes", "poses", "surface_points"]
