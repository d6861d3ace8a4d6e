"""How far is one robot from another? By what it can reach, and by what it looks like."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import KDTree

from xew.sim_warp.kinematics import link_matrices
from xew.sim_warp.robots import RobotSpec, load_urdf

CONFIGURATIONS = 1500
CLOUD_POINTS = 4000
"""The paper's numbers (its appendix on embodiment distances)."""

HUE_BINS = SATURATION_BINS = 16
WHITE = 250
"""A pixel of a robot-only render is ground where all channels are at least this."""


def workspace_cloud(robot: RobotSpec, seed: int = 0) -> np.ndarray:
    """Where the links of a robot can be.

    1,500 configurations of its first (left) arm, uniform within the URDF's joint limits, the gripper open and other
    joints at zero; the origins of all links of the URDF in its root frame, of which 4,000 are kept at random. What the
    paper leaves open (one arm, gripper open, root frame) is what comes nearest to its published distances.

    Args:
        robot: an entry of ROBOTS.
        seed: of the sampling.

    Returns:
        [p 3] float64, metres.
    """
    rng = np.random.default_rng(seed)
    urdf, arm = load_urdf(robot.urdf), robot.arms[0]
    joint_pos = np.zeros((CONFIGURATIONS, len(urdf.joint_names)))
    for name in arm.joints:
        joint = urdf.joints[name]
        low, high = (joint.lower, joint.upper) if joint.kind != "continuous" else (-np.pi, np.pi)
        joint_pos[:, urdf.joint_names.index(name)] = rng.uniform(low, high, CONFIGURATIONS)
    for name, opened in zip(arm.fingers, arm.finger_open, strict=True):
        joint_pos[:, urdf.joint_names.index(name)] = opened
    origins = np.concatenate([matrix[:, :3, 3] for matrix in link_matrices(urdf, joint_pos).values()])
    return origins[rng.choice(len(origins), min(CLOUD_POINTS, len(origins)), replace=False)]


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Symmetric Chamfer distance of two clouds [p 3]: the mean of the two mean distances to the nearest point, metres."""
    return float((KDTree(b).query(a)[0].mean() + KDTree(a).query(b)[0].mean()) / 2)


def appearance_descriptor(renders: np.ndarray) -> np.ndarray:
    """What a robot looks like, as one vector.

    For each view a 16 x 16 histogram of hue and saturation over the robot's pixels (sum 1) and the seven Hu moments of its
    silhouette, log-transformed; mean over views.

    Args:
        renders: [v h w 3] uint8 RGB, the robot alone on white; the paper uses nine standard views.

    Returns:
        [263] float64.

    Raises:
        ValueError: a view shows no robot.
    """
    return np.mean([_view_descriptor(view, i) for i, view in enumerate(renders)], axis=0)


def cosine_distance(a: np.ndarray, b: np.ndarray) -> float:
    """1 - cos of the angle between two descriptors: 0 for the same direction, 2 for opposite ones."""
    return float(1 - a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def mean_distances(matrix: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Each robot's mean distance to the others, from a symmetric matrix [n n] with a zero diagonal."""
    matrix = np.asarray(matrix, np.float64)
    return matrix.sum(axis=1) / (len(matrix) - 1)


def _view_descriptor(view: np.ndarray, index: int) -> np.ndarray:
    robot = (view < WHITE).any(axis=-1)
    if not robot.any():
        raise ValueError(f"view {index} shows no robot; every pixel is white. Render the robot alone on a white ground.")
    hsv = cv2.cvtColor(view, cv2.COLOR_RGB2HSV)
    ranges = [0, 180, 0, 256]
    histogram = cv2.calcHist([hsv], [0, 1], robot.astype(np.uint8), [HUE_BINS, SATURATION_BINS], ranges)
    moments = cv2.HuMoments(cv2.moments(robot.astype(np.uint8), binaryImage=True)).reshape(-1)
    logs = -np.sign(moments) * np.log10(np.maximum(np.abs(moments), 1e-30))
    return np.concatenate([histogram.reshape(-1) / histogram.sum(), logs])
