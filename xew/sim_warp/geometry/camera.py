"""Pinhole cameras by the convention of `xew.episode.project`; the named ones are in `xew.sim_warp.cameras`."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from xew import episode
from xew.episode import HEIGHT, WIDTH
from xew.protocol import HEAD_SPEC, CameraSpec


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion or skew."""

    intrinsics: np.ndarray = field(repr=False)
    """[3 3] float64, K [pixels]; the principal point of a centered camera is ((width - 1) / 2, (height - 1) / 2)."""
    extrinsics: np.ndarray
    """[4 4] float64, world to camera [m]; [t 4 4] for a camera that moves, one pose for each frame."""
    width: int = WIDTH
    height: int = HEIGHT

    @property
    def position(self) -> np.ndarray:
        """[3] center of projection, world frame [m]; [t 3] of a camera that moves."""
        if self.moves:
            return -np.einsum("tji,tj->ti", self.extrinsics[:, :3, :3], self.extrinsics[:, :3, 3])
        return -self.extrinsics[:3, :3].T @ self.extrinsics[:3, 3]

    @property
    def moves(self) -> bool:
        """Whether there is a pose for each frame."""
        return self.extrinsics.ndim == 3


def look_at(
    position: Sequence[float],
    target: Sequence[float],
    up: Sequence[float] = (0.0, 0.0, 1.0),
    vertical_fov: float = 37.0,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> Camera:
    """A centered camera at `position` [m] facing `target` [m], with `up` upward in the image.

    Args:
        vertical_fov: full vertical angle of view [deg].

    Raises:
        ValueError: `up` is parallel to the line of sight, or position and target coincide.
    """
    forward = np.subtract(target, position).astype(float)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(f"a camera at {tuple(position)} cannot look at {tuple(target)} with up {tuple(up)}: choose another.")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    extrinsics = np.eye(4)
    extrinsics[:3, :3] = rotation
    extrinsics[:3, 3] = -rotation @ np.asarray(position, float)
    focal = height / 2 / np.tan(np.radians(vertical_fov) / 2)
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(intrinsics, extrinsics, width, height)


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [... 2] and depths along the optical axis [...] m of world points [... 3] m, see `xew.episode.project`."""
    return episode.project(points, camera.intrinsics, camera.extrinsics)


def spec_camera(spec: CameraSpec) -> Camera:
    """The camera in the frame of what it is fixed to, [4 4] from that frame to the camera's."""
    return look_at(spec.position, spec.target, spec.up, spec.vertical_fov, *spec.size)


HEAD_CAMERA = spec_camera(HEAD_SPEC)
"""RoboTwin's head camera: fixed above the table, 53 degrees down, vertical field of view 37 degrees."""
