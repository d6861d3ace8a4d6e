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
"""Factor of the distance to an object where its place was not seen."""
CLOSING = 5
"""Side of the kernel [pixels] that closes gaps of an object."""
BLUR = 10.0
"""Standard deviation [pixels] of the ground's blur in a filled hole."""


def find_object(canvas: Image, unseen: Mask, point: np.ndarray, near: float, reach: float) -> Mask | None:
    """The connected pixels, unlike the ground, at a point [2] within two radii [pixels]; None if there are too few.

    Of the objects that several limits of shadows give, it is the most convex one: shadows join objects that are apart.
    """
    rows, columns = np.ogrid[: canvas.shape[0], : canvas.shape[1]]
    distance = np.hypot(rows - point[1], columns - point[0])
    allowed = (unseen == 0) & (distance <= reach)
    x, y = np.clip(np.rint(point), 0, np.array(canvas.shape[1::-1]) - 1).astype(int)
    touched = distance <= near * (HIDDEN if unseen[y, x] else 1)
    parts = [find_part(differ(canvas, shadow) & allowed, touched) for shadow in SHADOWS]
    objects = [part for part in parts if part is not None and cv2.countNonZero(part) >= LEAST_PIXELS]
    return max(objects, key=convexity, default=None)


def find_part(differs: Bool[np.ndarray, "h w"], near: Bool[np.ndarray, "h w"]) -> Mask | None:
    """The connected part of pixels [h w] with the most of them near a place, without gaps and holes; None if there is none."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CLOSING, CLOSING))
    count, labels = cv2.connectedComponents(cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_CLOSE, kernel))
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


def convexity(mask: Mask) -> float:
    """Share of the convex hull of a mask [h w] that it fills."""
    hull = np.zeros_like(mask)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outlines(mask))), (255,))
    return cv2.countNonZero(mask) / cv2.countNonZero(hull)


def ground_color(image: Image) -> np.ndarray:
    """The most frequent color [3] of an image, in steps of 8 levels."""
    coarse = (image >> 3).astype(np.int32) @ np.array([1024, 32, 1])
    return np.median(image[coarse == np.bincount(coarse.ravel()).argmax()], axis=0)


def differ(image: Image, shadow: float = SHADOWS[0]) -> Bool[np.ndarray, "h w"]:
    """Pixels [h w] that are neither ground nor its shadow."""
    ratio = image / np.maximum(ground_color(image), 1).astype(np.float32)
    least, most = ratio.min(axis=-1), ratio.max(axis=-1)
    return (least < shadow) | (most > BRIGHT) | (most - least > TINT)


def fill(image: Image, hole: Mask) -> Image:
    """The image [h w 3] with a hole [h w] filled by the ground around it."""
    ground = (~differ(image) & (hole == 0)).astype(np.float32)[..., None]
    known = np.concatenate([image * ground, ground], axis=-1)
    summed = cv2.GaussianBlur(known, (0, 0), BLUR) + 1e-3 * np.append(ground_color(image), 1)
    return np.where(hole[..., None] > 0, np.rint(summed[..., :3] / summed[..., 3:]).astype(np.uint8), image)
