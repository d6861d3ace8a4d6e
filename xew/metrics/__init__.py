"""(prediction, target) -> scores: jitted JAX functions, arrays in, arrays out; only `evaluate` reads files.

    from xew.metrics import psnr, METRICS
    psnr(prediction, target)          # uint8 [t h w 3] -> float32 [t]

docs/metrics.md shows each by an example. `xew.metrics.states` takes video in parts. To add a metric: a function in the
file of its family, one line in METRICS.
"""

import math

from xew.metrics.image import exact_frames, psnr, ssim
from xew.metrics.mask import boundary_f1, mask_iou, mask_scores
from xew.metrics.metric import Metric
from xew.metrics.perceptual import lpips, lpips_features, lpips_from_features, region_lpips, region_lpips_frames
from xew.metrics.track import contact_f1, coverage, keypoint_error, ndtw, pck, pck_05, trajectory_error

INF = math.inf
METRICS = {
    "psnr": Metric(psnr, psnr, "visual", "dB", (0, INF), True, "video", "of RGB; exact frames capped as in the paper"),
    "ssim": Metric(ssim, ssim, "visual", "", (-1, 1), True, "video", "Wang et al. 2004, as scikit-image: uniform 7x7 windows"),
    "lpips": Metric(lpips, lpips, "visual", "", (0, INF), False, "video", "Zhang et al. 2018, AlexNet v0.1"),
    "mask_iou": Metric(mask_iou, mask_iou, "morphology", "", (0, 1), True, "mask", "intersection over union of robot masks"),
    "boundary_f1": Metric(boundary_f1, boundary_f1, "morphology", "", (0, 1), True, "mask", "mask contours within 2 px"),
    "region_lpips": Metric(
        region_lpips, region_lpips_frames, "morphology", "", (0, INF), False, "region", "LPIPS in the box of all robot masks"
    ),
    "pck": Metric(pck, None, "kinematics", "", (0, 1), True, "track", "share within 0.1 of the keypoints' box diagonal"),
    "pck_05": Metric(pck_05, None, "kinematics", "", (0, 1), True, "track", "share within 0.05 of that diagonal"),
    "keypoint_error": Metric(keypoint_error, None, "kinematics", "px", (0, INF), False, "track", "mean keypoint distance"),
    "ndtw": Metric(ndtw, None, "kinematics", "", (0, INF), False, "track", "time warping / (lengths x mean box diagonal)"),
    "coverage": Metric(coverage, None, "kinematics", "", (0, 1), True, "track", "share of visible keypoints that were found"),
    "trajectory_error": Metric(trajectory_error, None, "objects", "px", (0, INF), False, "track", "mean object distance"),
    "object_coverage": Metric(coverage, None, "objects", "", (0, 1), True, "track", "share of visible objects that were found"),
}
"""All metrics by name, in the order of the paper's dimensions."""

__all__ = [
    "METRICS",
    "Metric",
    "boundary_f1",
    "contact_f1",
    "coverage",
    "exact_frames",
    "keypoint_error",
    "lpips",
    "lpips_features",
    "lpips_from_features",
    "mask_iou",
    "mask_scores",
    "ndtw",
    "pck",
    "pck_05",
    "psnr",
    "region_lpips",
    "region_lpips_frames",
    "ssim",
    "trajectory_error",
]
