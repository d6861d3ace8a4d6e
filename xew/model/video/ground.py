"""Objects on the ground of a picture, and the ground without them. The ground is the most frequent color, with its shadows."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

Image = UInt8[np.ndarray, "h w 3"]
Mask = UInt8[np.ndarray, "h w"]
"""255 inside and 0 outside."""

SHADOWS, BRIGHT, TINT = (0.8, 0.7), 1.06, 0.06
"""Ratios of a pixel's channels to the ground's: limits of the darkest shadow, the brightest ground, and the largest difference
of the channels. On validation scenes 99.9 % of the table lie above the second limit."""
LEAST_PIXELS = 25
"""Number of pixels of the smallest object."""
HIDDEN = 2.5
"""Factor of the distance to an object where its place was not seen, behind the robot or out of view."""
CLOSING = 5
"""Diameter [pixels] of the disk that closes gaps of an object, and grows it before its place is filled."""
BLUR = 10.0
"""Standard deviation [pixels] of the ground's blur in a filled hole."""
SPREAD = 5
"""Distance [pixels] over which objects run out into a hole."""


def find_object(canvas: Image, unseen: Mask, point: np.ndarray, near: float, reach: float, ground: np.ndarray) -> Mask | None:
    """The connected pixels, unlike the ground [3], at a point [2] within two radii [pixels]; None if there are too few.

    Of the objects that several limits of shadows give, it is the most convex one: shadows join objects that are apart.
    """
    rows, columns = np.ogrid[: canvas.shape[0], : canvas.shape[1]]
    distance = np.hypot(rows - point[1], columns - point[0])
    allowed = (unseen == 0) & (distance <= reach)
    touched = distance <= near * (1 if (distance[unseen == 0] < 1).any() else HIDDEN)
    parts = [find_part(differ(canvas, ground, shadow) & allowed, touched) for shadow in SHADOWS]
    objects = [part for part in parts if part is not None and cv2.countNonZero(part) >= LEAST_PIXELS]
    return max(objects, key=lambda mask: cv2.countNonZero(mask) / cv2.countNonZero(hull(mask)), default=None)


def complete(canvas: Image, unseen: Mask, mask: Mask, point: np.ndarray) -> Mask:
    """Draw what the robot hid of an object: what is seen of it, turned by 180 degrees about the point [2] where it is grasped.

    Returns the pixels drawn, which were unseen: those of the convex hull of both.
    """
    turn, size = np.array([[-1, 0, 2 * point[0]], [0, -1, 2 * point[1]]]), mask.shape[::-1]
    turned = cv2.warpAffine(mask, turn, size, flags=cv2.INTER_NEAREST) & unseen & ~mask
    cv2.copyTo(cv2.warpAffine(canvas, turn, size), turned, canvas)
    hidden = hull(mask | turned) & unseen & ~mask
    canvas[:] = cv2.inpaint(canvas, hidden & ~turned, SPREAD, cv2.INPAINT_TELEA)
    return hidden


def find_part(differs: Bool[np.ndarray, "h w"], near: Bool[np.ndarray, "h w"]) -> Mask | None:
    """The connected part of pixels [h w] with the most of them near a place, without gaps and holes; None if there is none."""
    count, labels = cv2.connectedComponents(cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_CLOSE, disk(CLOSING)))
    touching = np.bincount(labels[near], minlength=count)
    touching[0] = 0
    if not touching.any():
        return None
    mask = (labels == touching.argmax()).astype(np.uint8) * 255
    cv2.drawContours(mask, outlines(mask), -1, (255,), cv2.FILLED)
    return mask


def outlines(mask: Mask) -> list[np.ndarray]:
    """Outer outlines [n 1 2] x y of a mask [h w]."""
    return list(cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])


def hull(mask: Mask) -> Mask:
    """The convex hull of a mask [h w] that is not empty."""
    return cv2.fillConvexPoly(np.zeros_like(mask), cv2.convexHull(np.concatenate(outlines(mask))), (255,))


def ground_color(image: Image) -> np.ndarray:
    """The most frequent color [3] of an image, in steps of 8 levels."""
    coarse = (image >> 3).astype(np.int32) @ np.array([1024, 32, 1])
    return np.median(image[coarse == np.bincount(coarse.ravel()).argmax()], axis=0)


def differ(image: Image, ground: np.ndarray, shadow: float = SHADOWS[0]) -> Bool[np.ndarray, "h w"]:
    """Pixels [h w] that are neither ground of a color [3] nor its shadow."""
    red, green, blue = cv2.split(image / np.maximum(ground, 1).astype(np.float32))
    least, most = cv2.min(cv2.min(red, green), blue), cv2.max(cv2.max(red, green), blue)
    return (least < shadow) | (most > BRIGHT) | (most - least > TINT)


def fill(image: Image, hole: Mask, ground: np.ndarray) -> None:
    """Fill a hole [h w] of an image [h w 3] with the ground [3] around it, into which objects at its border run out."""
    x, y, width, height = cv2.boundingRect(hole)
    box = surround(np.array([x, y]), np.array([x + width, y + height]), 4 * BLUR)
    part, inside = image[box], hole[box]
    objects = differ(part, ground) & (inside == 0)
    level = (~objects & (inside == 0)).astype(np.float32)[..., None]
    summed = cv2.GaussianBlur(np.concatenate([part * level, level], axis=-1), (0, 0), BLUR) + 1e-3 * np.append(ground, 1)
    cv2.copyTo(np.rint(summed[..., :3] / summed[..., 3:]).astype(np.uint8), inside, part)
    border = cv2.dilate(objects.astype(np.uint8), disk(2 * SPREAD + 1)) * inside
    part[:] = cv2.inpaint(part, border, SPREAD, cv2.INPAINT_TELEA)


def surround(low: np.ndarray, high: np.ndarray, margin: float) -> tuple[slice, slice]:
    """The rows and columns of an image from a pixel x y [2] to another one, and a margin [pixels] around them."""
    left, top = (max(int(value - margin), 0) for value in low)
    right, bottom = (max(int(value + margin) + 1, 0) for value in high)
    return slice(top, bottom), slice(left, right)


def disk(size: int) -> Mask:
    """Kernel [size size] of a disk."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)).astype(np.uint8)
