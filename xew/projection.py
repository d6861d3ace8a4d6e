"""The pinhole camera of all rooms: where a point of the world lands in the image. NumPy only.

Pixels: x right, y down, (0, 0) is the center of the upper left pixel. Camera frame: x right, y down, z forward. Neither
distortion nor skew.
"""

import numpy as np


def project(points: np.ndarray, intrinsics: np.ndarray, extrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images of points of the world.

    Args:
        points: [... 3] m, world frame.
        intrinsics: [3 3] K [pixels].
        extrinsics: [4 4] world to camera [m].

    Returns:
        Pixels [... 2] and depths along the optical axis [...] m, both float64 where an argument is. A point at or behind the
        camera (depth <= 0) has no image; its pixels are NaN.
    """
    in_camera = points @ extrinsics[:3, :3].T + extrinsics[:3, 3]
    depth = in_camera[..., 2]
    focal = intrinsics[[0, 1], [0, 1]]
    front = np.where(depth > 0, depth, np.nan)
    return focal * in_camera[..., :2] / front[..., None] + intrinsics[:2, 2], depth
