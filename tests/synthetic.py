"""Tiny paired data without a simulator: flat two-link arms that push a disc about, written as real episodes.

The camera hangs one meter above the table and looks down; everything moves in the table's plane. As in real data, the
scene and the path of the hands depend on (task, seed) alone and only looks and link lengths depend on the robot.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from xew.dataset import VIEWS, find_accepted
from xew.episode import HEIGHT, WIDTH, Record, States, array_hash, read_pixels, read_states, write_episode
from xew.protocol import ACTION_DIM, ARMS, ROBOT_NAMES, CameraSpec

FOCAL = 320.0
INTRINSICS = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
EXTRINSICS = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
SHOULDERS = np.array([[-0.3, -0.3], [0.3, -0.3]])
KEYPOINT_NAMES = tuple(f"{arm}_{part}" for arm in ("left", "right") for part in ("shoulder", "elbow", "tool"))
DISC_RADIUS = 0.045


@dataclass(frozen=True)
class Look:
    """How one synthetic robot differs from the others: color and widths [pixels], link lengths [m]."""

    color: tuple[int, int, int]
    thickness: int
    lengths: tuple[float, float]


LOOKS = {
    "aloha_agilex": Look((30, 30, 34), 13, (0.26, 0.28)),
    "arx_x5": Look((90, 90, 96), 15, (0.30, 0.24)),
    "ur5_wsg": Look((80, 120, 170), 18, (0.28, 0.30)),
    "franka_panda": Look((225, 225, 230), 20, (0.32, 0.28)),
    "piper": Look((60, 45, 70), 11, (0.25, 0.26)),
}


@dataclass(frozen=True)
class Scene:
    """What a (task, seed) fixes for all robots."""

    ground: np.ndarray
    """[h w 3] uint8."""
    disc_color: tuple[int, int, int]
    disc: np.ndarray
    """[t 2] m, path of the disc's center."""
    hands: np.ndarray
    """[t 2 2] m, paths of the left and right hand."""


def write_synthetic_data(
    root: Path,
    tasks: Sequence[str] = ("place_empty_cup",),
    seeds: Sequence[int] = (0, 1, 1_000_000),
    robots: Sequence[str] = ROBOT_NAMES,
    frames: int = 17,
) -> list[Path]:
    """Write an accepted episode for every (task, seed, robot); returns their folders in that order."""
    return [write_cell(Path(root), task, seed, robot, frames) for task in tasks for seed in seeds for robot in robots]


def write_cell(root: Path, task: str, seed: int, robot: str, frames: int) -> Path:
    """Write one episode of `frames` frames and return its folder."""
    scene = sample_scene(task, seed, frames)
    look = LOOKS[robot]
    joints = inverse_kinematics(scene.hands, look.lengths)
    points = np.stack([forward_kinematics(joints[:, arm], SHOULDERS[arm], look.lengths) for arm in range(2)], 1)
    pixels = project(points)
    mask = np.stack([draw_robot(np.zeros((HEIGHT, WIDTH), np.uint8), frame, 255, look.thickness) > 0 for frame in pixels])
    empty = np.stack([draw_disc(scene.ground, center, scene.disc_color) for center in project(scene.disc)])
    white = np.full_like(empty, 255)
    shading = shade(look.color, mask)
    record = Record(
        task, seed, robot, True, instruction=f"push the disc ({task})", frame_count=frames, object_names=("disc",),
        keypoint_names=KEYPOINT_NAMES, scene_hash=array_hash(scene.ground, scene.disc), device="synthetic",
    )  # fmt: skip
    states = make_states(scene, joints, points, pixels, mask)
    return write_episode(
        root, record, states, np.where(mask[..., None], shading, empty), np.where(mask[..., None], shading, white)
    )


def write_synthetic_view(root: Path, spec: CameraSpec) -> None:
    """Add a view of every episode: the same pictures, mirrored, at the camera's size; one that moves has a pose a frame."""
    width, height = spec.size

    def resize(video: np.ndarray) -> np.ndarray:
        return np.stack([cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)[:, ::-1] for frame in video])

    for folder, record in find_accepted(root):
        states = read_states(folder)
        moved = np.tile(states.extrinsics, (record.frame_count, 1, 1)) if spec.moves else states.extrinsics
        mask = resize(states.robot_mask.astype(np.uint8)) > 0
        seen = replace(
            states, robot_mask=mask, extrinsics=moved, intrinsics=np.diag([width / WIDTH, height / HEIGHT, 1]) @ INTRINSICS
        )
        videos = [resize(read_pixels(folder, name)) for name in ("rgb", "robot")]
        write_episode(root / VIEWS / spec.view, replace(record, camera=spec, table=0.74), seen, *videos)


def sample_scene(task: str, seed: int, frames: int) -> Scene:
    """The scene of a (task, seed): a textured ground, a disc, and two smooth hand paths of which one pushes the disc."""
    rng = np.random.default_rng([sum(task.encode()), seed])
    coarse = rng.uniform(-12, 12, (HEIGHT // 40, WIDTH // 40, 3)).astype(np.float32)
    ground = np.clip(rng.uniform(150, 200, 3) + cv2.resize(coarse, (WIDTH, HEIGHT)), 0, 255).astype(np.uint8)
    start, goal = rng.uniform(-0.15, 0.15, (2, 2))
    phase = np.clip(np.linspace(-0.6, 1.2, frames), 0, 1)[:, None]
    disc = start + (goal - start) * (3 * phase**2 - 2 * phase**3)
    reach = np.clip(np.linspace(0, 3, frames), 0, 1)[:, None]
    home = np.array([[-0.25, 0.1], [0.25, 0.1]]) + rng.uniform(-0.05, 0.05, (2, 2))
    pushing = int(start[0] > 0)
    hands = np.repeat(home[None], frames, 0)
    hands[:, pushing] = home[pushing] * (1 - reach) + disc * reach
    hands[:, 1 - pushing, 1] += 0.05 * np.sin(np.linspace(0, np.pi, frames))
    return Scene(ground, tuple(int(c) for c in rng.integers(40, 255, 3)), disc, hands)


def inverse_kinematics(hands: np.ndarray, lengths: tuple[float, float]) -> np.ndarray:
    """Shoulder and elbow angles [t arm 2] that bring both hands [t arm 2] as near their paths as the links reach."""
    first, second = lengths
    offset = hands - SHOULDERS
    distance = np.clip(np.linalg.norm(offset, axis=-1), 0.05, first + second - 1e-3)
    elbow = np.arccos(np.clip((distance**2 - first**2 - second**2) / (2 * first * second), -1, 1)) * np.array([1, -1])
    shoulder = np.arctan2(offset[..., 1], offset[..., 0]) - np.arctan2(second * np.sin(elbow), first + second * np.cos(elbow))
    return np.stack([shoulder, elbow], -1)


def forward_kinematics(angles: np.ndarray, shoulder: np.ndarray, lengths: tuple[float, float]) -> np.ndarray:
    """Shoulder, elbow and hand [t 3 2] m of one arm from its two angles [t 2]."""
    elbow = shoulder + lengths[0] * np.stack([np.cos(angles[:, 0]), np.sin(angles[:, 0])], -1)
    total = angles.sum(-1)
    return np.stack(
        [np.broadcast_to(shoulder, elbow.shape), elbow, elbow + lengths[1] * np.stack([np.cos(total), np.sin(total)], -1)], 1
    )


def project(points: np.ndarray) -> np.ndarray:
    """Points of the table plane [... 2] m to pixels [... 2]."""
    return points * np.array([FOCAL, -FOCAL]) + INTRINSICS[:2, 2]


def draw_robot(image: np.ndarray, pixels: np.ndarray, color: int, thickness: int) -> np.ndarray:
    """Both arms [arm 3 2] as thick lines and round joints, without anti-aliasing so that the mask is exact."""
    for shoulder, elbow, hand in np.round(pixels).astype(int).tolist():
        cv2.line(image, shoulder, elbow, color, thickness)
        cv2.line(image, elbow, hand, color, thickness * 2 // 3)
        cv2.circle(image, hand, thickness // 2, color, -1)
    return image


def draw_disc(ground: np.ndarray, center: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return cv2.circle(ground.copy(), np.round(center).astype(int).tolist(), int(DISC_RADIUS * FOCAL), color, -1)


def shade(color: tuple[int, int, int], mask: np.ndarray) -> np.ndarray:
    """The robot's color [t h w 3], darker towards its rim."""
    depth = np.stack([cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, 3) for m in mask])
    light = 0.7 + 0.3 * np.minimum(depth / 5, 1)
    return np.clip(light[..., None] * np.array(color), 0, 254).astype(np.uint8)


def make_states(scene: Scene, joints: np.ndarray, points: np.ndarray, pixels: np.ndarray, mask: np.ndarray) -> States:
    """The arrays an episode stores; measured joints are the commanded ones."""
    frames = len(joints)
    action = np.zeros((frames, ACTION_DIM), np.float32)
    for arm, (arm_slice, gripper) in enumerate(ARMS):
        action[:, arm_slice.start : arm_slice.start + 2] = joints[:, arm]
        action[:, gripper] = 0.5
    hands = points[:, :, 2]
    flat = pixels.reshape(frames, -1, 2)
    inside = (flat >= 0).all(-1) & (flat[..., 0] < WIDTH) & (flat[..., 1] < HEIGHT)
    return States(
        action=action, joint_pos=action.copy(), joint_vel=np.gradient(action, axis=0).astype(np.float32),
        tool_pose=planar_pose(hands), object_pose=planar_pose(scene.disc[:, None]),
        object_joint=np.zeros((frames, 1), np.float32),
        contact=np.linalg.norm(hands - scene.disc[:, None], axis=-1)[..., None] < DISC_RADIUS,
        penetration=np.zeros((frames, 1), np.float32),
        keypoints=flat.astype(np.float32), keypoint_visible=inside, robot_mask=mask,
        intrinsics=INTRINSICS.copy(), extrinsics=EXTRINSICS.copy(),
    )  # fmt: skip


def planar_pose(points: np.ndarray) -> np.ndarray:
    """Poses [... 7] float32 in the table plane from points [... 2] m."""
    height = np.broadcast_to(np.float32([0, 0, 0, 0, 1]), (*points.shape[:-1], 5))
    return np.concatenate([points, height], -1).astype(np.float32)
