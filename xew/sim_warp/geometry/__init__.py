"""Shapes and places: triangle meshes, poses with their transforms, and the pinhole camera.

Arrays in meters and radians in, arrays out; nothing here knows robots, tasks or a device.
"""

__all__ = ["camera", "meshes", "poses", "surface_points"]
