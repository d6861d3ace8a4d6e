"""Links of a URDF posed by some of its joints: their poses, and the points that a joint moves."""

from collections.abc import Mapping

import numpy as np

from xew.sim_warp.embodiment.urdf import Urdf
from xew.sim_warp.kinematics.forward import link_matrices


def pose_links(urdf: Urdf, positions: Mapping[str, float] | None = None) -> dict[str, np.ndarray]:
    """Poses [4 4] of all links in the root's frame, with joints at `positions` [rad or m] by name and all others at 0."""
    row = np.array([[(positions or {}).get(name, 0.0) for name in urdf.joint_names]])
    return {name: frame[0] for name, frame in link_matrices(urdf, row).items()}


def moved_points(urdf: Urdf, joint: str, poses: Mapping[str, np.ndarray], frame: np.ndarray) -> np.ndarray:
    """Points [k 3] m of the links that a joint moves, in a frame [4 4], which is like `poses` [4 4] in the root's frame.

    They are corners of collision shapes, or vertices of links without any; without shapes the origin of the joint's child.
    """
    to_frame, clouds = np.linalg.inv(frame), []
    for link in urdf.moved_links(joint):
        pose = to_frame @ poses[link.name]
        shapes = [shape.points for shape in link.collisions] or ([link.visual.vertices] if link.visual else [])
        clouds += [shape @ pose[:3, :3].T + pose[:3, 3] for shape in shapes]
    return np.concatenate(clouds) if clouds else (to_frame @ poses[urdf.joints[joint].child])[None, :3, 3]


def nearest_axis(direction: np.ndarray) -> np.ndarray:
    """The unit vector [3] along the coordinate axis that is nearest to a direction [3]."""
    axis = np.zeros(3)
    axis[np.argmax(np.abs(direction))] = np.sign(direction[np.argmax(np.abs(direction))])
    return axis
