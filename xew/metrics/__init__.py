"""(prediction, target) -> scores: jitted JAX functions, arrays in, arrays out; only `evaluate` reads files.

    from xew.metrics import psnr, METRICS
    psnr(prediction, target)          # uint8 [t h w 3] -> float32 [t]

To add a metric: a function in the file of its family, one line in METRICS.
"""

import math

from xew.metrics.image import psnr, ssim
from xew.metrics.mask import boundary_f1, mask_iou
from xew.metrics.metric import Metric
from xew.metrics.perceptual import lpips, region_lpips
from xew.metrics.track import keypoint_error, ndtw, pck, trajectory_error

METRICS = {
    "psnr": Metric(psnr, "visual", "dB", (0, math.inf), True, True, ("video",), "exact frames capped as in the paper"),
    "ssim": Metric(ssim, "visual", "", (-1, 1), True, True, ("video",), "Wang et al. 2004, as scikit-image: uniform 7x7"),
    "lpips": Metric(lpips, "visual", "", (0, math.inf), False, True, ("video",), "Zhang et al. 2018, AlexNet v0.1"),
    "mask_iou": Metric(mask_iou, "morphology", "", (0, 1), True, True, ("mask",), "intersection over union"),
    "boundary_f1": Metric(boundary_f1, "morphology", "", (0, 1), True, True, ("mask",), "contours within 2 px"),
    "region_lpips": Metric(
        region_lpips,
        "morphology",
        "",
        (0, math.inf),
        False,
        False,
        ("video", "mask"),
        "LPIPS in the box of all masks",
    ),
    "pck": Metric(pck, "kinematics", "", (0, 1), True, False, ("track",), "nearer than 0.1 of the keypoints' box diagonal"),
    "keypoint_error": Metric(keypoint_error, "kinematics", "px", (0, math.inf), False, False, ("track",), "mean distance"),
    "ndtw": Metric(ndtw, "kinematics", "", (0, math.inf), False, False, ("track",), "DTW / (both lengths x mean box diagonal)"),
    "trajectory_error": Metric(trajectory_error, "objects", "px", (0, math.inf), False, False, ("track",), "mean distance"),
}
"""All metrics by name, in the order of the paper's dimensions."""

__all__ = ["METRICS", "Metric", *METRICS]
