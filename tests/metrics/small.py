"""Episodes of a few small frames, many of them, for what is about their number."""

from pathlib import Path

import numpy as np

from xew.episode import Record, States, write_episode
from xew.rollout import write_rollout

HEIGHT, WIDTH = 32, 48


def write_many(root: Path, count: int, frames: int = 3) -> None:
    """`count` episodes of a square that wanders, under root/data, and rollouts of one that lags, under root/rollouts."""
    rng = np.random.default_rng(0)
    ground = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for seed in range(count):
        start = rng.integers(0, 20, 2)
        corners = start + np.arange(frames)[:, None]
        mask = np.zeros((frames, HEIGHT, WIDTH), bool)
        for t, (x, y) in enumerate(corners):
            mask[t, y : y + 8, x : x + 8] = True
        video = np.where(mask[..., None], np.uint8(200), ground)
        points = np.stack([corners, corners + 7], axis=1).astype(np.float32)
        record = Record("wander", seed, "piper", True, frame_count=frames, object_names=(), keypoint_names=("a", "b"))
        write_episode(root / "data", record, _states(frames, points, mask), video, video)
        late = video[np.maximum(np.arange(frames) - 1, 0)]
        write_rollout(root / "rollouts", "wander", seed, "piper", late, {"model": "late"})


def _states(frames: int, points: np.ndarray, mask: np.ndarray) -> States:
    nothing = np.zeros((frames, 0), np.float32)
    return States(
        *(np.zeros((frames, 16), np.float32) for _ in range(3)),
        tool_pose=np.zeros((frames, 2, 7), np.float32),
        object_pose=np.zeros((frames, 0, 7), np.float32),
        object_joint=nothing,
        contact=np.zeros((frames, 2, 0), bool),
        penetration=nothing,
        keypoints=points,
        keypoint_visible=np.ones(points.shape[:2], bool),
        robot_mask=mask,
        intrinsics=np.eye(3),
        extrinsics=np.eye(4),
    )
