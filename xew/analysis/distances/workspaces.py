"""Kinematic distance: what a robot's links can reach, and how far two such clouds of points are apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import ConvexHull, KDTree

from xew.analysis.distances.matrices import symmetric_matrix
from xew.concurrency import usable_cores
from xew.sim_warp.kinematics.forward import link_matrices
from xew.sim_warp.robots import RobotSpec, Urdf, UrdfError, load_urdf

CONFIGURATIONS = 1500
"""Number of joint configurations that one draw samples, the paper's (its appendix on embodiment distances)."""
CLOUD_POINTS = 4000

ANOTHER_DRAW = 1_000_000
"""Offset between the seeds of two draws of one robot."""

ROBOTWIN_OPEN = {"arx_x5": 0.045, "ur5_wsg": 0.06, "franka_panda": 0.05}
"""Positions at which RoboTwin's `gripper_scale` holds the fingers of open grippers [m], beyond the limits of the URDF. The
paper does not say how wide its grippers stood; of five ways tried this one comes nearest to its reach and hull volume."""

Frame = Literal["root", "arm_base", "arm_alone"]
"""Coordinate frame of a workspace. `root`: all links in the URDF's root frame, which gives the paper's figures. `arm_base`: all
links in the frame of the link that carries the arm's first joint, which is what its text says. `arm_alone`: in that frame the
links of this arm only, so neither a body nor the height of a stand counts (ours)."""


@dataclass(frozen=True)
class Workspace:
    """Positions that the links of a robot reach in one draw of configurations."""

    cloud: np.ndarray
    """[p 3] float64 origins of links in the chosen frame, at most CLOUD_POINTS of them [m]."""
    reach: float
    """Largest distance of a link's origin from the frame's origin over all configurations [m]."""
    volume: float
    """Volume of the convex hull of all origins [m³]."""


@dataclass(frozen=True)
class Features:
    """Workspaces of several robots over several seeds."""

    robots: tuple[str, ...]
    dof: np.ndarray
    """[n] int, number of joints of one arm."""
    links: np.ndarray
    """[n] int, number of links of the URDF."""
    reach: np.ndarray
    """[s n] float64, largest reach by seed and robot [m]."""
    volume: np.ndarray
    """[s n] float64, volume of the convex hull by seed and robot [m³]."""
    kinematic: np.ndarray
    """[s n n] float64, Chamfer distances of workspaces by seed [m]."""


def measure(
    robots: Mapping[str, RobotSpec | Urdf], seeds: Sequence[int] = (0,), frame: Frame = "root", workers: int = -1
) -> Features:
    """Kinematic distances and features of robots, by name, in a frame; one draw of configurations for each seed.

    `workers` threads compare the clouds, -1 for one a core.
    """
    draws = [[workspace(robot, seed, frame) for robot in robots.values()] for seed in seeds]
    return Features(
        robots=tuple(robots),
        dof=np.array([len(_choose_joints(robot)[1]) for robot in robots.values()]),
        links=np.array([len(_choose_joints(robot)[0].links) for robot in robots.values()]),
        reach=np.array([[one.reach for one in draw] for draw in draws]),
        volume=np.array([[one.volume for one in draw] for draw in draws]),
        kinematic=np.array([chamfer_matrix([one.cloud for one in draw], workers) for draw in draws]),
    )


def chamfer_floor(robots: Mapping[str, RobotSpec | Urdf], seeds: Sequence[int] = (0,)) -> np.ndarray:
    """Chamfer distance of each robot to another draw of itself [s n] float64 [m]: the floor that sampling sets. Ours."""

    def measure_to_itself(robot: RobotSpec | Urdf, seed: int) -> float:
        return chamfer(workspace_cloud(robot, seed), workspace_cloud(robot, seed + ANOTHER_DRAW))

    return np.array([[measure_to_itself(robot, seed) for robot in robots.values()] for seed in seeds])


def workspace(robot: RobotSpec | Urdf, seed: int = 0, frame: Frame = "root") -> Workspace:
    """Sample the positions that the links of a robot reach.

    One draw is 1,500 configurations of the first (left) arm, uniform within the URDF's joint limits. The gripper is open, all
    other joints are at zero. 4,000 of the link origins are kept at random. Where the paper leaves a choice open, this one comes
    nearest to its published distances.

    Args:
        robot: an entry of ROBOTS, or a URDF, whose longest chain up to its last revolute joint is sampled.
        seed: seed of the sampling.
        frame: frame of the cloud.

    Raises:
        UrdfError: the URDF has no arm.
    """
    rng = np.random.default_rng(seed)
    urdf, joints, held = _choose_joints(robot)
    joint_pos = np.zeros((CONFIGURATIONS, len(urdf.joint_names)))
    for name in joints:
        joint = urdf.joints[name]
        low, high = (joint.lower, joint.upper) if joint.kind != "continuous" else (-np.pi, np.pi)
        joint_pos[:, urdf.joint_names.index(name)] = rng.uniform(low, high, CONFIGURATIONS)
    for name, position in held.items():
        joint_pos[:, urdf.joint_names.index(name)] = position
    frames = link_matrices(urdf, joint_pos)
    if frame != "root":
        frames = _move_to_arm_base(urdf, joints[0], frames, alone=frame == "arm_alone")
    by_link = [matrix[:, :3, 3] for matrix in frames.values()]
    origins = np.concatenate(by_link)
    kept = rng.choice(len(origins), min(CLOUD_POINTS, len(origins)), replace=False)
    # Links that do not move are in the cloud as often as the others; for what is outermost one copy will do.
    once = np.concatenate([points if (points != points[0]).any() else points[:1] for points in by_link])
    return Workspace(origins[kept], float(np.linalg.norm(once, axis=1).max()), _hull_volume(once))


def workspace_cloud(robot: RobotSpec | Urdf, seed: int = 0, frame: Frame = "root") -> np.ndarray:
    """The cloud [p 3] float64 of `workspace`: origins of links in `frame` [m]."""
    return workspace(robot, seed, frame).cloud


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Symmetric Chamfer distance of two clouds [p 3] and [q 3] in the same frame, in their unit (meters).

    It is the mean of the two mean distances to the nearest point.
    """
    return float(chamfer_matrix([a, b])[0, 1])


def chamfer_matrix(clouds: Sequence[np.ndarray], workers: int = 1) -> np.ndarray:
    """`chamfer` of every two of n clouds, each [p 3]: [n n] float64; `workers` threads share the pairs, -1 for one a core."""
    # A body's links are in a cloud hundreds of times: each place is searched from once, and counted as often as it occurs.
    places = [np.unique(cloud, axis=0, return_counts=True) for cloud in clouds]
    trees = [KDTree(points) for points, _ in places]

    def measure_directed(a: int, b: int) -> float:
        points, counts = places[a]
        return float(np.average(trees[b].query(points)[0], weights=counts))  # which lets go of Python's lock

    threads = usable_cores() if workers == -1 else workers
    return symmetric_matrix(len(clouds), lambda a, b: (measure_directed(a, b) + measure_directed(b, a)) / 2, threads)


def _choose_joints(robot: RobotSpec | Urdf) -> tuple[Urdf, tuple[str, ...], dict[str, float]]:
    """A robot's URDF, the joints to sample, from the base outwards, and where others are held that are not at zero."""
    if isinstance(robot, RobotSpec):
        arm = robot.arms[0]
        opened = [float(np.copysign(ROBOTWIN_OPEN.get(robot.key, abs(place)), place)) for place in arm.finger_open]
        return load_urdf(robot.urdf), arm.joints, dict(zip(arm.fingers, opened, strict=True))
    chains = [[joint for joint in robot.chain(link) if joint.name in robot.joint_names] for link in robot.links]
    arms = [chain for chain in chains if chain and chain[-1].kind != "prismatic"]
    if not arms:
        raise UrdfError(f"{robot.path} has no revolute joint, so it has no arm whose workspace could be sampled.")
    return robot, tuple(joint.name for joint in max(arms, key=len)), {}


def _move_to_arm_base(urdf: Urdf, first_joint: str, frames: Mapping[str, np.ndarray], alone: bool) -> dict[str, np.ndarray]:
    """Frames [n 4 4] in that of the link that carries an arm's first joint: of all links, or of it and those beyond."""
    base = urdf.joints[first_joint].parent
    beyond = [link for link in urdf.links if first_joint in [joint.name for joint in urdf.chain(link)]]
    to_base = np.linalg.inv(frames[base])
    return {link: to_base @ frames[link] for link in ((base, *beyond) if alone else urdf.links)}


def _hull_volume(points: np.ndarray) -> float:
    """Volume of the convex hull of points [p 3]; 0 where all lie in a plane."""
    if np.linalg.matrix_rank(points - points[0], tol=1e-9) < 3:
        return 0.0
    return float(ConvexHull(points).volume)
