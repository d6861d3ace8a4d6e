"""How far is one robot from another? By what it can reach, and by what it looks like.

    python -m xew.analysis.distance --out distances                    # the five robots, with the paper's figures beside
    python -m xew.analysis.distance --robot lab/my_arm.urdf --out out  # and one of one's own

Kinematic and appearance distance are the paper's (its appendix on embodiment distances). Ours: the spread over sampling
seeds, workspaces in the frame of the arm's base, and a perceptual distance of the reference renders.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import cv2
import numpy as np
from scipy.spatial import ConvexHull, KDTree

from xew.sim_warp.kinematics.forward import link_matrices
from xew.sim_warp.robots import RobotSpec, Urdf, UrdfError, load_urdf

CONFIGURATIONS = 1500
CLOUD_POINTS = 4000
"""The paper's numbers (its appendix on embodiment distances)."""

ANOTHER_DRAW = 1_000_000
"""Between the seeds of two draws of one robot."""

ROBOTWIN_OPEN = {"arx_x5": 0.045, "ur5_wsg": 0.06, "franka_panda": 0.05}
"""Where RoboTwin's `gripper_scale` holds the fingers of open grippers, meters: beyond the limits of the URDF, to press. The
paper does not say how its grippers stood; of five ways this one comes nearest to its reach and hull volume."""

HUE_BINS = SATURATION_BINS = 16
WHITE = 250
"""A pixel of a robot-only render is ground where all channels are at least this."""

Frame = Literal["root", "arm_base", "arm_alone"]
"""Of workspaces. `root`: all links in the URDF's root frame, which gives the paper's figures. `arm_base`: all links in the
frame of the link that carries the arm's first joint, which is what its text says. `arm_alone`: in that frame the links of
this arm only, so that neither a body nor the height of a stand counts (ours)."""
ImageDistance = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Of two videos or lists of views [n h w 3] uint8, frame by frame: [n]."""


@dataclass(frozen=True)
class Workspace:
    """Where the links of a robot can be, by one draw of configurations."""

    cloud: np.ndarray
    """[p 3] float64 at most 4,000 origins of links, meters."""
    reach: float
    """Largest distance of a link's origin from the frame's origin over all configurations, meters."""
    volume: float
    """Of the convex hull of all origins, cubic meters."""


@dataclass(frozen=True)
class Features:
    """Workspaces of several robots over several seeds."""

    robots: tuple[str, ...]
    dof: np.ndarray
    """[n] joints of one arm."""
    links: np.ndarray
    """[n] links of the URDF."""
    reach: np.ndarray
    """[s n] meters."""
    volume: np.ndarray
    """[s n] cubic meters."""
    kinematic: np.ndarray
    """[s n n] workspace Chamfer distances, meters."""


def measure(
    robots: Mapping[str, RobotSpec | Urdf], seeds: Sequence[int] = (0,), frame: Frame = "root", workers: int = -1
) -> Features:
    """Kinematic distances and features of robots, one draw of configurations for each seed.

    Args:
        robots: by name.
        seeds: of the sampling.
        frame: that clouds are in.
        workers: threads of the nearest-neighbor search; -1 for all cores.
    """
    draws = [[workspace(robot, seed, frame) for robot in robots.values()] for seed in seeds]
    return Features(
        robots=tuple(robots),
        dof=np.array([len(_sampled(robot)[1]) for robot in robots.values()]),
        links=np.array([len(_sampled(robot)[0].links) for robot in robots.values()]),
        reach=np.array([[one.reach for one in draw] for draw in draws]),
        volume=np.array([[one.volume for one in draw] for draw in draws]),
        kinematic=np.array([chamfer_matrix([one.cloud for one in draw], workers) for draw in draws]),
    )


def chamfer_floor(robots: Mapping[str, RobotSpec | Urdf], seeds: Sequence[int] = (0,), frame: Frame = "root") -> np.ndarray:
    """How far a robot is from itself by another draw [s n], meters: what sampling makes of no distance at all. Ours."""

    def to_itself(robot: RobotSpec | Urdf, seed: int) -> float:
        return chamfer(workspace_cloud(robot, seed, frame), workspace_cloud(robot, seed + ANOTHER_DRAW, frame))

    return np.array([[to_itself(robot, seed) for robot in robots.values()] for seed in seeds])


def workspace(robot: RobotSpec | Urdf, seed: int = 0, frame: Frame = "root") -> Workspace:
    """Where the links of a robot can be.

    1,500 configurations of its first (left) arm, uniform within the URDF's joint limits, the gripper open and other
    joints at zero; the origins of all links of the URDF in its root frame, of which 4,000 are kept at random. What the
    paper leaves open (one arm, gripper open, root frame) is what comes nearest to its published distances.

    Args:
        robot: an entry of ROBOTS; or any URDF, of which the joints up to the last revolute one of its longest chain are
            sampled and all others stay at zero.
        seed: of the sampling.
        frame: of the cloud.

    Raises:
        UrdfError: the URDF has no arm.
    """
    rng = np.random.default_rng(seed)
    urdf, joints, held = _sampled(robot)
    joint_pos = np.zeros((CONFIGURATIONS, len(urdf.joint_names)))
    for name in joints:
        joint = urdf.joints[name]
        low, high = (joint.lower, joint.upper) if joint.kind != "continuous" else (-np.pi, np.pi)
        joint_pos[:, urdf.joint_names.index(name)] = rng.uniform(low, high, CONFIGURATIONS)
    for name, position in held.items():
        joint_pos[:, urdf.joint_names.index(name)] = position
    frames = link_matrices(urdf, joint_pos)
    if frame != "root":
        frames = _from_arm_base(urdf, joints[0], frames, alone=frame == "arm_alone")
    by_link = [matrix[:, :3, 3] for matrix in frames.values()]
    origins = np.concatenate(by_link)
    kept = rng.choice(len(origins), min(CLOUD_POINTS, len(origins)), replace=False)
    # Links that do not move are in the cloud as often as the others; for what is outermost one copy will do.
    once = np.concatenate([points if (points != points[0]).any() else points[:1] for points in by_link])
    return Workspace(origins[kept], float(np.linalg.norm(once, axis=1).max()), _hull_volume(once))


def workspace_cloud(robot: RobotSpec | Urdf, seed: int = 0, frame: Frame = "root") -> np.ndarray:
    """The points [p 3] of `workspace`, meters."""
    return workspace(robot, seed, frame).cloud


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Symmetric Chamfer distance of two clouds [p 3]: the mean of the two mean distances to the nearest point, meters."""
    return float(chamfer_matrix([a, b])[0, 1])


def chamfer_matrix(clouds: Sequence[np.ndarray], workers: int = 1) -> np.ndarray:
    """`chamfer` of every two clouds [n n]; `workers` threads search, -1 for all cores."""
    # A body's links are in a cloud hundreds of times: each place is searched from once, and counted as often as it occurs.
    places = [np.unique(cloud, axis=0, return_counts=True) for cloud in clouds]
    trees = [KDTree(points) for points, _ in places]

    def directed(a: int, b: int) -> float:
        points, counts = places[a]
        return float(np.average(trees[b].query(points, workers=workers)[0], weights=counts))

    return _symmetric(len(clouds), lambda a, b: (directed(a, b) + directed(b, a)) / 2)


def appearance_descriptor(renders: np.ndarray) -> np.ndarray:
    """What a robot looks like, as one vector.

    For each view a 16 x 16 histogram of hue and saturation over the robot's pixels (sum 1) and the seven Hu moments of its
    silhouette, log-transformed; mean over views. The logarithms keep the moments' signs, as is customary. The last three
    moments are tiny and of either sign, so their logarithms jump between large positive and negative numbers and outweigh
    all else, colors too.

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


def appearance_matrix(renders: Sequence[np.ndarray]) -> np.ndarray:
    """Cosine distances [n n] of the descriptors of n robots' renders, each [v h w 3]."""
    descriptors = [appearance_descriptor(views) for views in renders]
    return _symmetric(len(renders), lambda a, b: cosine_distance(descriptors[a], descriptors[b]))


def perceptual_matrices(renders: Sequence[np.ndarray], distance: ImageDistance) -> np.ndarray:
    """Distances of n robots' renders, each [v h w 3], a matrix for each view [v n n]; for example by `xew.metrics.lpips`. Ours.

    The views of all robots are of the same azimuths, so that like is laid over like.
    """
    matrices = np.zeros((len(renders[0]), len(renders), len(renders)))
    for a, b in combinations(range(len(renders)), 2):
        matrices[:, a, b] = matrices[:, b, a] = distance(renders[a], renders[b])
    return matrices


def mean_distances(matrix: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Each robot's mean distance to the others, from symmetric matrices [... n n] with a zero diagonal."""
    matrix = np.asarray(matrix, np.float64)
    return matrix.sum(axis=-1) / (matrix.shape[-1] - 1)


def _symmetric(count: int, distance: Callable[[int, int], float]) -> np.ndarray:
    matrix = np.zeros((count, count))
    for a, b in combinations(range(count), 2):
        matrix[a, b] = matrix[b, a] = distance(a, b)
    return matrix


def _sampled(robot: RobotSpec | Urdf) -> tuple[Urdf, tuple[str, ...], dict[str, float]]:
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


def _from_arm_base(urdf: Urdf, first_joint: str, frames: Mapping[str, np.ndarray], alone: bool) -> dict[str, np.ndarray]:
    """Frames [n 4 4] in that of the link that carries an arm's first joint: of all links, or of it and those beyond."""
    base = urdf.joints[first_joint].parent
    beyond = [link for link in urdf.links if first_joint in [joint.name for joint in urdf.chain(link)]]
    to_base = np.linalg.inv(frames[base])
    return {link: to_base @ frames[link] for link in ((base, *beyond) if alone else urdf.links)}


def _hull_volume(points: np.ndarray) -> float:
    """0 where all points lie in a plane."""
    if np.linalg.matrix_rank(points - points[0], tol=1e-9) < 3:
        return 0.0
    return float(ConvexHull(points).volume)


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


if __name__ == "__main__":
    # The command shows the paper's figures beside ours, and whoever reads these needs this module.
    from xew.analysis.distance_command import run

    run()
