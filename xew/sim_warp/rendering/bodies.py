"""A robot's bodies for the renderer: one per visible link, posed by canonical joint positions; the left copy first."""

from functools import lru_cache

import numpy as np

from xew.sim_warp.embodiment.spec import RobotSpec
from xew.sim_warp.embodiment.urdf import Urdf, load_urdf
from xew.sim_warp.kinematics.forward import link_poses
from xew.sim_warp.rendering.packing import Body

SIDES = ("left", "right")


def robot_bodies(spec: RobotSpec) -> list[Body]:
    """The robot's visible links in the order of `robot_pose`; calls share the meshes."""
    links = load_urdf(spec.urdf).links
    meshes = {name: link.visual for name, link in links.items() if link.visual is not None}
    return [Body(meshes[name], is_robot=True) for _, name in body_names(spec)]


def robot_pose(spec: RobotSpec, joint_pos: np.ndarray) -> np.ndarray:
    """World poses of the visible links.

    Args:
        joint_pos: [t 16] canonical joint positions [rad] and grippers [0 closed, 1 open], measured or commanded.

    Returns:
        [t b 7] float32, xyz [m] and quaternion xyzw.
    """
    poses = link_poses(spec, joint_pos)
    return np.stack([poses[copy][link] for copy, link in body_names(spec)], 1).astype(np.float32)


def keypoint_links(spec: RobotSpec) -> list[tuple[int, str, str]]:
    """Keypoints as (copy of the URDF, link, name such as left/link3): the child links of each arm's joints and fingers."""
    urdf = load_urdf(spec.urdf)
    keypoints = []
    for index, (side, arm) in enumerate(zip(SIDES, spec.arms, strict=True)):
        copy = 0 if spec.one_urdf_holds_both_arms else index
        links = [urdf.joints[joint].child for joint in (*arm.joints, *arm.fingers)]
        keypoints += [(copy, link, f"{side}/{link}") for link in links]
    return keypoints


@lru_cache(maxsize=256)
def body_names(spec: RobotSpec) -> tuple[tuple[int, str], ...]:
    """(copy of the URDF, link) of each body of `robot_bodies`."""
    urdf = load_urdf(spec.urdf)
    copies = 1 if spec.one_urdf_holds_both_arms else 2
    return tuple((copy, name) for copy in range(copies) for name, link in urdf.links.items() if link.visual is not None)


def nearby_links(urdf: Urdf, link: str) -> set[str]:
    """A link and its neighbors."""
    joined = {joint.parent for joint in urdf.joints.values() if joint.child == link}
    return joined | {joint.child for joint in urdf.joints.values() if joint.parent == link} | {link}
