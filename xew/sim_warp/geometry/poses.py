"""Poses: x y z [m] and quaternion x y z w, and the homogeneous transforms that they stand for."""

import numpy as np
from scipy.spatial.transform import Rotation

Pose = tuple[float, float, float, float, float, float, float]
"""Position x y z [m] and quaternion x y z w."""


def pose_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """[... 4 4] to [... 7], with quaternions of w >= 0."""
    quaternion = Rotation.from_matrix(matrix[..., :3, :3]).as_quat(canonical=True)
    return np.concatenate([matrix[..., :3, 3], quaternion], -1)


def matrix_from_pose(pose: Pose | np.ndarray) -> np.ndarray:
    """[... 7] to [... 4 4]."""
    pose = np.asarray(pose, float)
    matrix = np.zeros((*pose.shape[:-1], 4, 4))
    matrix[..., :3, :3] = Rotation.from_quat(pose[..., 3:]).as_matrix()
    matrix[..., :3, 3] = pose[..., :3]
    matrix[..., 3, 3] = 1
    return matrix
