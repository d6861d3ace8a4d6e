"""Metrics of predicted video, jitted JAX functions of a prediction and its target, and the list of them all (METRICS).

    from xew.metrics import psnr, METRICS
    psnr(prediction, target)          # uint8 [t h w 3] -> float32 [t]

docs/metrics.md shows each by an example. `Metric.total` takes video in parts. To add a metric, write a function in the file of
its family and one entry in METRICS below.
"""

import functools
import math

from xew.metrics.image import exact_frames, psnr, ssim
from xew.metrics.mask import boundary_f1, mask_iou
from xew.metrics.metric import Metric
from xew.metrics.perceptual import (
    lpips,
    lpips_embedding,
    region_lpips,
    region_lpips_frames,
    robot_lpips,
    robot_lpips_frames,
    robot_lpips_parts,
)
from xew.metrics.track import (
    coverage,
    distances,
    hits,
    keypoint_error,
    keypoint_error_strict,
    ndtw,
    ndtw_strict,
    pck,
    pck_05,
    pck_strict,
    presence,
    strict_distances,
    strict_hits,
    strict_warpings,
    trajectory_error,
    trajectory_error_strict,
    warpings,
)

INF = math.inf
PAPER, STRICT = ("paper",), ("strict",)
METRICS = {
    "psnr": Metric(
        psnr, psnr, "visual", "dB", (0, INF), True, "video", "of RGB; exact frames capped as in the paper",
        "PSNR", whole=True),
    "ssim": Metric(
        ssim, ssim, "visual", "", (-1, 1), True, "video", "Wang et al. 2004, as scikit-image: uniform 7x7 windows", "SSIM"),
    "lpips": Metric(lpips, lpips, "visual", "", (0, INF), False, "video", "Zhang et al. 2018, AlexNet v0.1", "LPIPS"),
    "mask_iou": Metric(
        mask_iou, mask_iou, "morphology", "", (0, 1), True, "mask", "intersection over union of robot masks", "Mask IoU"),
    "boundary_f1": Metric(
        boundary_f1, boundary_f1, "morphology", "", (0, 1), True, "mask", "mask contours within 2 px", "Boundary F1"),
    "region_lpips": Metric(
        region_lpips, region_lpips_frames, "morphology", "", (0, INF), False, "region", "LPIPS in the box of all robot masks",
        "Region LPIPS", suites=PAPER),
    "robot_lpips": Metric(
        robot_lpips, robot_lpips_frames, "morphology", "", (0, INF), False, "robot",
        "LPIPS's maps weighted by the share of the robot in each receptive field", "Robot LPIPS",
        parts=robot_lpips_parts, suites=STRICT, counterpart="region_lpips"),
    "pck": Metric(
        pck, None, "kinematics", "", (0, 1), True, "track", "share within 0.1 of the keypoints' box diagonal",
        "PCK", parts=hits, suites=PAPER),
    "pck_strict": Metric(
        pck_strict, None, "kinematics", "", (0, 1), True, "track",
        "TAP-Vid's position accuracy: share within 1 to 16 px of 256, lost points are misses",
        "Strict PCK", parts=strict_hits, suites=STRICT, counterpart="pck", points="surfaces", by_image=True),
    "pck_05": Metric(
        pck_05, None, "kinematics", "", (0, 1), True, "track", "share within 0.05 of that diagonal",
        "PCK at 0.05", reported=False, parts=functools.partial(hits, alpha=0.05), suites=PAPER),
    "keypoint_error": Metric(
        keypoint_error, None, "kinematics", "px", (0, INF), False, "track", "mean keypoint distance",
        "Keypoint error", parts=distances, suites=PAPER),
    "keypoint_error_strict": Metric(
        keypoint_error_strict, None, "kinematics", "px", (0, INF), False, "track",
        "mean distance of robot points; lost ones have 50 px of 256, PointOdyssey's failure",
        "Strict keypoint error", parts=strict_distances, suites=STRICT, counterpart="keypoint_error",
        points="surfaces", by_image=True),
    "ndtw": Metric(
        ndtw, None, "kinematics", "", (0, INF), False, "track", "time warping / (lengths x mean box diagonal)",
        "nDTW", whole=True, parts=warpings, suites=PAPER),
    "ndtw_strict": Metric(
        ndtw_strict, None, "kinematics", "", (0, 0.5), False, "track",
        "time warping with the strict error as cost / (lengths x its maximum)",
        "Strict nDTW", whole=True, parts=strict_warpings, suites=STRICT, counterpart="ndtw", points="surfaces", by_image=True),
    "coverage": Metric(
        coverage, None, "kinematics", "", (0, 1), True, "track", "share of visible keypoints that were found",
        "Keypoints found", reported=False, parts=presence, suites=PAPER),
    "coverage_strict": Metric(
        coverage, None, "kinematics", "", (0, 1), True, "track", "share of visible robot points that were found",
        "Robot points found", reported=False, parts=presence, suites=STRICT, counterpart="coverage", points="surfaces"),
    "trajectory_error": Metric(
        trajectory_error, None, "objects", "px", (0, INF), False, "track", "mean object distance",
        "Object error", suites=PAPER),
    "trajectory_error_strict": Metric(
        trajectory_error_strict, None, "objects", "px", (0, INF), False, "track",
        "mean distance of points on objects that move; lost ones have 50 px of 256, PointOdyssey's failure",
        "Strict object error", parts=strict_distances, suites=STRICT, counterpart="trajectory_error",
        points="surfaces", by_image=True),
    "object_coverage": Metric(
        coverage, None, "objects", "", (0, 1), True, "track", "share of visible objects that were found",
        "Objects found", reported=False, parts=presence, suites=PAPER),
    "object_coverage_strict": Metric(
        coverage, None, "objects", "", (0, 1), True, "track", "share of visible points on objects that were found",
        "Object points found", reported=False, parts=presence, suites=STRICT, counterpart="object_coverage", points="surfaces"),
}  # fmt: skip
"""All metrics by name, in the order of the paper's dimensions."""

__all__ = [
    "METRICS",
    "Metric",
    "boundary_f1",
    "coverage",
    "exact_frames",
    "keypoint_error",
    "keypoint_error_strict",
    "lpips",
    "lpips_embedding",
    "mask_iou",
    "ndtw",
    "ndtw_strict",
    "pck",
    "pck_05",
    "pck_strict",
    "psnr",
    "region_lpips",
    "region_lpips_frames",
    "robot_lpips",
    "robot_lpips_frames",
    "ssim",
    "trajectory_error",
    "trajectory_error_strict",
]
