"""RoboTwin HDF5 files as RoboTwin writes them, made of a robot of ours: what the importer is tested on."""

from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from xew.episode import HEIGHT, WIDTH
from xew.sim_warp.geometry.camera import HEAD_CAMERA
from xew.sim_warp.geometry.poses import matrix_from_pose, pose_from_matrix
from xew.sim_warp.kinematics.forward import tool_matrix
from xew.sim_warp.robots import ROBOTS, RobotSpec

RED = (200, 30, 20)
BASES = ((-0.3, -0.35, 0.784, 0, 0, 0.5**0.5, 0.5**0.5), (0.3, -0.35, 0.784, 0, 0, 0.5**0.5, 0.5**0.5))
"""Where RoboTwin puts the ARX X5, 0.6 m apart."""
FRAMES = 5


def placed() -> RobotSpec:
    """The ARX X5 as RoboTwin has it: its bases, and the tool center point 0.12 m from link 6."""
    robot = ROBOTS["arx_x5"]
    arms = tuple(
        replace(arm, root_pose=base, tool_pose=(0.12, 0, 0, 0, 0, 0, 1)) for arm, base in zip(robot.arms, BASES, strict=True)
    )
    return replace(robot, arms=(arms[0], arms[1]))


def joints() -> np.ndarray:
    """[t 2 6] drive targets that move all joints a little."""
    swing = 0.1 * np.arange(FRAMES)[:, None, None] * np.linspace(0.2, 1, 6)
    return np.array([arm.home for arm in ROBOTS["arx_x5"].arms]) + swing * [[1], [-1]]


def grippers() -> np.ndarray:
    return np.stack([np.linspace(1, 0, FRAMES), np.linspace(0, 1, FRAMES)], 1)


def tool_poses() -> np.ndarray:
    """[t 2 7] tool center points in the world, quaternion x y z w."""
    return np.stack([pose_from_matrix(tool_matrix(placed(), arm, joints()[:, arm])) for arm in (0, 1)], 1)


def end_poses() -> np.ndarray:
    """[t 2 7] as RoboTwin stores them: 0.12 m behind the tool center point, quaternion w x y z."""
    tools = matrix_from_pose(tool_poses())
    behind = tools[..., :3, 3] - 0.12 * tools[..., :3, 0]
    quaternion = Rotation.from_matrix(tools[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(FRAMES, 2, 4)
    return np.concatenate([behind, quaternion[..., [3, 0, 1, 2]]], -1)


def picture(size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """RGB [h w 3] with a red block on white."""
    image = np.full((size[1], size[0], 3), 255, np.uint8)
    image[size[1] // 4 : size[1] // 2, size[0] // 4 : size[0] // 2] = RED
    return image


def encoded(image: np.ndarray, marked: bool = False) -> bytes:
    """The JPEG of an RGB image: as if it were BGR or, in newer files, an ordinary one with a mark."""
    if not marked:
        return cv2.imencode(".jpg", image)[1].tobytes()
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
    mark = b"XPL-RGB1"
    return jpeg[:2] + b"\xff\xfe" + (len(mark) + 2).to_bytes(2, "big") + mark + jpeg[2:]


def intrinsics() -> np.ndarray:
    """RoboTwin counts pixels from the corner of the first."""
    found = HEAD_CAMERA.intrinsics.copy()
    found[:2, 2] += 0.5
    return found


def write_legacy(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """An episode of the older layout, with its file of instructions in the folder next to it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    instructions = path.parents[1] / "instructions" / f"{path.stem}.json"
    instructions.parent.mkdir(exist_ok=True)
    instructions.write_text('{"seen": ["put the block on the mat"], "unseen": []}')
    scale = np.diag([size[0] / WIDTH, size[0] / WIDTH, 1])
    with h5py.File(path, "w") as file:
        for arm, side in enumerate(("left", "right")):
            file[f"joint_action/{side}_arm"] = joints()[:, arm]
            file[f"joint_action/{side}_gripper"] = grippers()[:, arm]
            file[f"endpose/{side}_endpose"] = end_poses()[:, arm]
        pictures = [encoded(picture(size))] * FRAMES
        file.create_dataset("observation/head_camera/rgb", data=pictures, dtype=f"S{len(pictures[0]) + 7}")
        file["observation/head_camera/intrinsic_cv"] = np.tile(scale @ intrinsics(), (FRAMES, 1, 1))
        file["observation/head_camera/extrinsic_cv"] = np.tile(HEAD_CAMERA.extrinsics[:3], (FRAMES, 1, 1))
    return path


def wrist_extrinsics(arm: int) -> np.ndarray:
    """[t 4 4] world to a camera 0.1 m behind the tool center point that looks along the hand."""
    to_tool = np.linalg.inv(matrix_from_pose(tool_poses()[:, arm]))
    return np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0.1], [0, 0, 0, 1.0]]) @ to_tool


def add_cameras(path: Path) -> Path:
    """Add the wrist cameras and a camera in front to a file, by the names and readings of its layout."""
    side = HEAD_CAMERA.extrinsics @ np.array([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    poses = [wrist_extrinsics(0), wrist_extrinsics(1), np.tile(side, (FRAMES, 1, 1))]
    with h5py.File(path, "a") as file:
        legacy = "observation" in file
        names = (
            ("left_camera", "right_camera", "front_camera")
            if legacy
            else ("cam_left_wrist", "cam_right_wrist", "cam_third_view")
        )
        for name, matrices in zip(names, poses, strict=True):
            group = f"{'observation' if legacy else 'vision'}/{name}"
            file[f"{group}/{'rgb' if legacy else 'colors'}"] = np.array([encoded(picture(), not legacy)] * FRAMES)
            file[f"{group}/{'intrinsic_cv' if legacy else 'intrinsic_matrix'}"] = intrinsics()
            if legacy:
                file[f"{group}/extrinsic_cv"] = matrices[:, :3]
            else:
                file[f"{group}/extrinsics_matrix"] = np.linalg.inv(matrices)
    return path


def write_modern(path: Path, marked: bool = True) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["data_format_version"] = "1.0"
        file["instructions"] = '["put the block on the mat", "another"]'
        file["additional_info/frequency"] = 15
        for group, frames in (("state", np.arange(FRAMES)), ("action", np.minimum(np.arange(FRAMES) + 1, FRAMES - 1))):
            for arm, side in enumerate(("left", "right")):
                file[f"{group}/{side}_arm_joint_states"] = joints()[frames, arm]
                file[f"{group}/{side}_ee_joint_states"] = grippers()[frames, arm][:, None]
                file[f"{group}/{side}_ee_poses"] = end_poses()[frames, arm]
        pictures = np.array([encoded(picture(), marked)] * FRAMES)
        file["vision/cam_head/colors"] = pictures
        file["vision/cam_head/intrinsic_matrix"] = intrinsics()
        file["vision/cam_head/extrinsics_matrix"] = np.linalg.inv(HEAD_CAMERA.extrinsics)
    return path
