"""The scene of an episode without its robot, in which closed grippers carry objects: from commands and the first frame alone.

Reads  the first frame, the commanded render, tools and grippers, and the camera
Writes uint8 [t h w 3]: the table where the robot was, and each grasped object, cut out of the first frame, with its hand

A hand that closes on nothing carries nothing. A later grasp can take an object again where it was left.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from xew.episode import WHITE, project
from xew.model.video.ground import CLOSING, SPREAD, Image, Mask, complete, disk, fill, find_object, ground_color, surround

Video = UInt8[np.ndarray, "t h w 3"]
Pose = Float[np.ndarray, "4 4"]
"""From a hand's frame into the world [m]."""

CLOSED, STILL, LEAST_SPAN = 0.4, 0.1, 0.1
"""Shares of a gripper's range: below the first it is closed; above its least value by less than the second it holds an object.
A gripper whose range is below the third never closes."""
NEAR, REACH, PASS_OVER = 0.02, 0.17, 0.1
"""Distances [m] from the point between the fingers: a held object is nearer than the first, cut off beyond the second, and goes
over to another closed hand that is nearer than the third when its own hand opens."""
SQUARE = 0.05 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
"""Corners of a square before the camera [m, camera frame] whose motion with the hand moves the picture of an object."""


@dataclass(frozen=True)
class View:
    """The camera of an episode."""

    intrinsics: Float[np.ndarray, "3 3"]
    extrinsics: Float[np.ndarray, "4 4"]

    def project(self, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, float]:
        """Pixels [n 2] and mean depth [m] of points [n 3] m in the world."""
        pixels, depth = project(points, self.intrinsics, self.extrinsics)
        return pixels, float(depth.mean())


@dataclass(frozen=True)
class Sprite:
    """The picture of an object, and where a square before the camera then was."""

    pixels: Image
    mask: Mask
    corner: np.ndarray
    """Pixel x y of the picture's upper left corner in the image."""
    source: Float[np.ndarray, "4 2"]
    """Pixels of the square when the picture was cut out."""
    depth: float
    """Depth of the square then [m]."""
    square: Float[np.ndarray, "4 3"]
    """Corners of the square [m] in the frame of the hand that holds the object."""

    def carried(self, pose: Pose) -> Float[np.ndarray, "4 3"]:
        """Corners of the square [m, world] with the hand at a pose."""
        return self.square @ pose[:3, :3].T + pose[:3, 3]


def carry(first: Image, render: Video, tools: np.ndarray, grippers: np.ndarray, view: View) -> Video:
    """The scene at every frame: [t h w 3] uint8.

    Args:
        first: [h w 3] uint8, first frame.
        render: [t h w 3] uint8, the commanded robot on white.
        tools: [t n 7] commanded poses of the hands, whose origins lie between the fingers.
        grippers: [t n] commanded, larger is wider.
    """
    unseen = cv2.dilate(silhouette(render[0]), np.ones((3, 3), np.uint8))
    poses = np.zeros((*tools.shape[:2], 4, 4))
    poses[..., :3, 3], poses[..., :3, :3] = tools[..., :3], Rotation.from_quat(tools[..., 3:]).as_matrix()
    canvas, ground = first.copy(), ground_color(first)
    fill(canvas, unseen, ground)
    held: dict[int, Sprite] = {}
    closed = np.stack([find_grasps(gripper) for gripper in grippers.T], axis=1)
    before = np.zeros(closed.shape[1], bool)
    scenes = np.empty((len(tools), *canvas.shape), np.uint8)
    for frame, now in enumerate(closed):
        for hand in np.flatnonzero(before & ~now).tolist():
            if hand in held:
                _release(canvas, held, hand, np.flatnonzero(now).tolist(), poses[frame - 1], view)
        for hand in np.flatnonzero(now & ~before).tolist():
            if hand not in held and (sprite := take(scenes[:frame], canvas, unseen, poses[frame, hand], view, ground)):
                held[hand] = sprite
        scenes[frame] = canvas
        for hand, sprite in held.items():
            draw(scenes[frame], sprite, poses[frame, hand], view)
        before = now
    return scenes


def paste(first: Image, scenes: Video, render: Video) -> Video:
    """A render [t h w 3] on white, pasted on the scenes [t h w 3]: [t h w 3] uint8, which begins with the first frame."""
    pasted = scenes.copy()
    for picture, frame in zip(pasted[1:], render[1:], strict=True):
        cv2.copyTo(frame, silhouette(frame), picture)
    pasted[0] = first
    return pasted


def silhouette(render: Image) -> Mask:
    """Where a render on white shows the robot."""
    return cv2.bitwise_not(cv2.inRange(render, (WHITE,) * 3, (255,) * 3))


def find_grasps(gripper: np.ndarray) -> np.ndarray:
    """Frames [t] bool in which a gripper [t], once open, is closed: from the end of its closing until it begins to open."""
    low, span = gripper.min(), np.ptp(gripper)
    grasped = np.zeros(len(gripper), bool)
    if span < LEAST_SPAN:
        return grasped
    edges = np.flatnonzero(np.diff(np.concatenate([[False], gripper < low + CLOSED * span, [False]]).astype(int)))
    for start, end in edges.reshape(-1, 2):
        still = start + np.flatnonzero(gripper[start:end] <= gripper[start:end].min() + STILL * span)
        grasped[still[0] : still[-1] + 1] = start > 0
    return grasped


def take(shown: Video, canvas: Image, unseen: Mask, pose: Pose, view: View, ground: np.ndarray) -> Sprite | None:
    """Cut the object at a hand out of the canvas [h w 3], which is filled with the ground [3]; None if there is none.

    What was hidden of it is added, also to the scenes [t h w 3] shown before.
    """
    (point,), depth = view.project(pose[None, :3, 3])
    if not depth > 0:
        return None
    scale = view.intrinsics[0, 0] / depth
    box = surround(point, point, REACH * scale)
    part, hidden, origin = canvas[box], unseen[box], np.array([box[1].start, box[0].start])
    mask = find_object(part, hidden, point - origin, NEAR * scale, REACH * scale, ground) if part.size else None
    if mask is None:
        return None
    added = complete(part, hidden, mask, point - origin)
    for scene in shown[(slice(None), *box)]:
        cv2.copyTo(part, added, scene)
    mask |= added
    x, y, width, height = cv2.boundingRect(mask)
    inner = slice(y, y + height), slice(x, x + width)
    square = pose[:3, 3] + SQUARE @ view.extrinsics[:3, :3]
    source, depth = view.project(square)
    sprite = Sprite(part[inner].copy(), mask[inner], origin + [x, y], source, depth, in_hand(square, pose))
    hole = np.zeros_like(unseen)
    hole[box] = mask
    rim, run_out = (cv2.dilate(hole, disk(CLOSING + size)) for size in (0, 2 * SPREAD))
    fill(canvas, rim | (run_out & unseen), ground)
    hidden[mask > 0] = 0
    return sprite


def in_hand(points: Float[np.ndarray, "n 3"], pose: Pose) -> Float[np.ndarray, "n 3"]:
    """Points [m, world] in the frame of a hand."""
    return (points - pose[:3, 3]) @ pose[:3, :3]


def draw(image: Image, sprite: Sprite, pose: Pose, view: View) -> None:
    """Draw a sprite into an image with its hand at a pose: shifted, turned in the image, and scaled by its depth."""
    target, depth = view.project(sprite.carried(pose))
    if not depth > 0 or not np.isfinite(target).all():
        return
    before, after = ((corners - corners.mean(axis=0)) @ [1, 1j] for corners in (sprite.source, target))
    factor = np.exp(1j * np.angle((after * before.conj()).sum())) * sprite.depth / depth
    matrix = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    offset = target.mean(axis=0) + matrix @ (sprite.corner - sprite.source.mean(axis=0))
    height, width = sprite.mask.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) @ matrix.T + offset
    low = np.clip(np.floor(corners.min(axis=0)) - 1, 0, image.shape[1::-1]).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0)) + 2, 0, image.shape[1::-1]).astype(int)
    if (high > low).all():
        _blend(image[low[1] : high[1], low[0] : high[0]], sprite, np.column_stack([matrix, offset - low]))


def _blend(part: Image, sprite: Sprite, motion: Float[np.ndarray, "2 3"]) -> None:
    """Blend a sprite, moved by an affine transform, into a part of an image."""
    size = part.shape[1::-1]
    pixels = cv2.warpAffine(sprite.pixels, motion, size, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    share = cv2.warpAffine(sprite.mask, motion, size)[..., None] / np.float32(255)
    part[:] = np.rint(part + share * (pixels - part))


def _release(canvas: Image, held: dict[int, Sprite], hand: int, closed: list[int], poses: np.ndarray, view: View) -> None:
    """Give what a hand held to a closed hand near it, or leave it where it is."""
    sprite = held.pop(hand)
    for other in closed:
        if other not in held and np.linalg.norm(poses[other, :3, 3] - poses[hand, :3, 3]) < PASS_OVER:
            held[other] = replace(sprite, square=in_hand(sprite.carried(poses[hand]), poses[other]))
            return
    draw(canvas, sprite, poses[hand], view)
