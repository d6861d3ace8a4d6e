"""Appearance distance: what robots look like, alone on white, by the paper's descriptor or by any embedding of images."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from scipy.spatial.distance import pdist, squareform

from xew.analysis.distances.matrices import symmetric_matrix
from xew.episode import WHITE

HUE_BINS = SATURATION_BINS = 16

ImageEmbedding = Callable[[np.ndarray], np.ndarray]
"""Vectors [n d] of images [n h w 3] uint8, whose squared Euclidean distances say how different the images look."""


def appearance_descriptor(renders: np.ndarray) -> np.ndarray:
    """Vector that describes a robot's appearance, the mean over its views.

    Each view gives a 16 x 16 histogram of hue and saturation over the robot's pixels (sum 1) and the signed logarithms of the
    seven Hu moments of its silhouette. The last three moments are tiny and of either sign, so their logarithms outweigh all
    other numbers.

    Args:
        renders: [v h w 3] uint8 RGB, the robot alone on white; the paper uses nine standard views.

    Returns:
        [263] float64.

    Raises:
        ValueError: a view shows no robot.
    """
    return describe_views(renders).mean(axis=0)


def describe_views(renders: np.ndarray) -> np.ndarray:
    """The descriptors of one robot's views by themselves, [v 263] float64; see `appearance_descriptor`."""
    return np.stack([_describe_view(view, i) for i, view in enumerate(renders)])


def cosine_distance(a: np.ndarray, b: np.ndarray) -> float:
    """1 - cos of the angle between two descriptors [d]: 0 for the same direction, 2 for opposite ones."""
    return float(1 - a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def appearance_matrix(renders: Sequence[np.ndarray]) -> np.ndarray:
    """Cosine distances [n n] float64 of the descriptors of n robots' renders, each [v h w 3] uint8."""
    return descriptor_matrix(np.stack([describe_views(views) for views in renders]))


def descriptor_matrix(views: np.ndarray) -> np.ndarray:
    """Cosine distances [n n] float64 of n robots, each described by the mean of its views' descriptors [n v 263]."""
    descriptors = views.mean(axis=1)
    return symmetric_matrix(len(descriptors), lambda a, b: cosine_distance(descriptors[a], descriptors[b]))


def perceptual_matrices(renders: Sequence[np.ndarray], embed: ImageEmbedding) -> np.ndarray:
    """Distances of n robots' renders, each [v h w 3] uint8, as a matrix for each view [v n n] float64. Ours.

    `embed` may be `xew.metrics.lpips_embedding`. View i has the same azimuth for every robot, so the same sides are compared.
    """
    by_view = [np.asarray(embed(np.stack(views))) for views in zip(*renders, strict=True)]
    return np.stack([squareform(pdist(vectors, "sqeuclidean")) for vectors in by_view])


def _describe_view(view: np.ndarray, index: int) -> np.ndarray:
    """The descriptor [263] of one view [h w 3] uint8; `index` names it in the error."""
    robot = (view < WHITE).any(axis=-1)
    if not robot.any():
        raise ValueError(f"view {index} shows no robot; every pixel is white. Render the robot alone on a white ground.")
    hsv = cv2.cvtColor(view, cv2.COLOR_RGB2HSV)
    ranges = [0, 180, 0, 256]
    histogram = cv2.calcHist([hsv], [0, 1], robot.astype(np.uint8), [HUE_BINS, SATURATION_BINS], ranges)
    moments = cv2.HuMoments(cv2.moments(robot.astype(np.uint8), binaryImage=True)).reshape(-1)
    logs = -np.sign(moments) * np.log10(np.maximum(np.abs(moments), 1e-30))
    return np.concatenate([histogram.reshape(-1) / histogram.sum(), logs])
