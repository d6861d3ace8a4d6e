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
from xew.metrics.motion import (
    aperture_errors,
    final_distances,
    final_object_error,
    flicker,
    flicker_frames,
    flicker_parts,
    flicker_robot,
    flicker_robot_frames,
    flicker_robot_parts,
    ghosts,
    gripper_error,
    onset_shift,
    onset_shifts,
)
from xew.metrics.outcome.measures import (
    counterfactual_retrieval,
    hallucinated_success,
    hallucinated_success_frames,
    hallucinated_success_parts,
    outcome_accuracy,
    progress_error,
    retrieval,
    retrieval_parts,
)
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
    found_distances,
    found_error,
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
from xew.statistics import mean_max_rank_violation, policy_ranking

INF = math.inf
PAPER, STRICT = ("paper",), ("strict",)
METRICS = {
    "psnr": Metric(
        psnr, psnr, "visual", "dB", (0, INF), True, "video", "of RGB; exact frames capped at the most attainable",
        "PSNR"),
    "ssim": Metric(
        ssim, ssim, "visual", "", (-1, 1), True, "video", "Wang et al. 2004, as scikit-image: uniform 7x7 windows", "SSIM"),
    "lpips": Metric(lpips, lpips, "visual", "", (0, INF), False, "video", "Zhang et al. 2018, AlexNet v0.1", "LPIPS"),
    "flicker": Metric(
        flicker, flicker_frames, "visual", "levels", (0, 510), False, "video",
        "change of the residual between frames where the truth stands still",
        "Flicker", whole=True, parts=flicker_parts, suites=STRICT),
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
    "flicker_robot": Metric(
        flicker_robot, flicker_robot_frames, "morphology", "levels", (0, 510), False, "robot",
        "change of the residual between frames on the robot",
        "Robot flicker", whole=True, parts=flicker_robot_parts, suites=STRICT),
    "ghosts": Metric(
        ghosts, ghosts, "morphology", "", (0, 1), False, "bodies",
        "share of the frame that shows something else than the still scene",
        "Ghosts", suites=STRICT),
    "pck": Metric(
        pck, None, "kinematics", "", (0, 1), True, "track", "share within 0.1 of the keypoints' box diagonal",
        "PCK", parts=hits, suites=PAPER, options=("diagonal",)),
    "pck_strict": Metric(
        pck_strict, None, "kinematics", "", (0, 1), True, "track",
        "TAP-Vid's position accuracy: share within 1 to 16 px of 256, lost points are misses",
        "Strict PCK", parts=strict_hits, suites=STRICT, counterpart="pck", points="surfaces", options=("side",)),
    "pck_05": Metric(
        pck_05, None, "kinematics", "", (0, 1), True, "track", "share within 0.05 of that diagonal",
        "PCK at 0.05", reported=False, parts=functools.partial(hits, alpha=0.05), suites=PAPER, options=("diagonal",)),
    "keypoint_error": Metric(
        keypoint_error, None, "kinematics", "px", (0, INF), False, "track",
        "mean keypoint distance, at most the image's diagonal",
        "Keypoint error", parts=distances, suites=PAPER, options=("largest",)),
    "keypoint_error_strict": Metric(
        keypoint_error_strict, None, "kinematics", "px", (0, INF), False, "track",
        "mean distance of robot points; lost ones have 50 px of 256, PointOdyssey's failure",
        "Strict keypoint error", parts=strict_distances, suites=STRICT, counterpart="keypoint_error",
        points="surfaces", options=("side",)),
    "keypoint_error_found": Metric(
        found_error, None, "kinematics", "px", (0, INF), False, "track",
        "mean distance of robot points that were found, at most 50 px of 256",
        "Error of found robot points", parts=found_distances, suites=STRICT, points="surfaces", options=("side",)),
    "ndtw": Metric(
        ndtw, None, "kinematics", "", (0, 0.5), False, "track", "time warping / (lengths x mean box diagonal)",
        "nDTW", whole=True, parts=warpings, suites=PAPER, options=("diagonal",)),
    "ndtw_strict": Metric(
        ndtw_strict, None, "kinematics", "", (0, 0.5), False, "track",
        "time warping with the strict error as cost / (lengths x its maximum)",
        "Strict nDTW", whole=True, parts=strict_warpings, suites=STRICT, counterpart="ndtw",
        points="surfaces", options=("side",)),
    "coverage": Metric(
        coverage, None, "kinematics", "", (0, 1), True, "track", "share of visible keypoints that were found",
        "Keypoints found", reported=False, parts=presence, suites=PAPER),
    "coverage_strict": Metric(
        coverage, None, "kinematics", "", (0, 1), True, "track", "share of visible robot points that were found",
        "Robot points found", reported=False, parts=presence, suites=STRICT, counterpart="coverage", points="surfaces"),
    "gripper_error": Metric(
        gripper_error, None, "kinematics", "px", (0, INF), False, "track",
        "error of the distance between the fingers of a hand, at most 16 px of 256",
        "Gripper error", parts=aperture_errors, suites=STRICT, points="surfaces", options=("side", "finger")),
    "trajectory_error": Metric(
        trajectory_error, None, "objects", "px", (0, INF), False, "track", "mean object distance, at most the image's diagonal",
        "Object error", suites=PAPER, options=("largest",)),
    "trajectory_error_strict": Metric(
        trajectory_error_strict, None, "objects", "px", (0, INF), False, "track",
        "mean distance of points on objects that move; lost ones have 50 px of 256, PointOdyssey's failure",
        "Strict object error", parts=strict_distances, suites=STRICT, counterpart="trajectory_error",
        points="surfaces", options=("side",)),
    "trajectory_error_found": Metric(
        found_error, None, "objects", "px", (0, INF), False, "track",
        "mean distance of points on objects that were found, at most 50 px of 256",
        "Error of found object points", parts=found_distances, suites=STRICT, points="surfaces", options=("side",)),
    "final_object_error": Metric(
        final_object_error, None, "objects", "px", (0, INF), False, "track",
        "strict object error over the last tenth of the frames",
        "Final object error", whole=True, parts=final_distances, suites=STRICT, points="surfaces", options=("side", "frames")),
    "onset_shift": Metric(
        onset_shift, None, "objects", "frames", (0, 16), False, "track",
        "frames between the true and the predicted first motion of an object",
        "Onset shift", whole=True, parts=onset_shifts, suites=STRICT, points="surfaces", options=("side", "body")),
    "object_coverage": Metric(
        coverage, None, "objects", "", (0, 1), True, "track", "share of visible objects that were found",
        "Objects found", reported=False, parts=presence, suites=PAPER),
    "object_coverage_strict": Metric(
        coverage, None, "objects", "", (0, 1), True, "track", "share of visible points on objects that were found",
        "Object points found", reported=False, parts=presence, suites=STRICT, counterpart="object_coverage", points="surfaces"),
    "outcome_accuracy": Metric(
        outcome_accuracy, outcome_accuracy, "outcome", "", (0, 1), True, "outcome",
        "whether judged success agrees with the simulator's, at the last frame", "Outcome accuracy", suites=STRICT),
    "progress_error": Metric(
        progress_error, progress_error, "outcome", "", (0, 1), False, "outcome",
        "difference of the judged progress from the simulator's, at the last frame", "Progress error", suites=STRICT),
    "hallucinated_success": Metric(
        hallucinated_success, hallucinated_success_frames, "outcome", "", (0, 1), False, "outcome",
        "whether a video shows success where the simulator fails", "Hallucinated success",
        parts=hallucinated_success_parts, suites=STRICT),
    "retrieval": Metric(
        retrieval, None, "outcome", "", (0, 1), True, "variants",
        "whether objects move as under these commands rather than under other commands in the same scene; chance is 1/k",
        "Counterfactual retrieval", parts=retrieval_parts, suites=STRICT),
    "retrieval_lpips": Metric(
        retrieval, None, "outcome", "", (0, 1), True, "variant_videos",
        "whether moving objects look as under these commands rather than under other commands in the same scene, by LPIPS; "
        "chance is 1/k",
        "Retrieval by LPIPS", parts=retrieval_parts, suites=STRICT),
}  # fmt: skip
"""All metrics by name, in the order of the paper's dimensions."""

__all__ = [
    "METRICS",
    "Metric",
    "boundary_f1",
    "counterfactual_retrieval",
    "coverage",
    "exact_frames",
    "final_object_error",
    "flicker",
    "flicker_robot",
    "found_error",
    "ghosts",
    "gripper_error",
    "hallucinated_success",
    "keypoint_error",
    "keypoint_error_strict",
    "lpips",
    "lpips_embedding",
    "mask_iou",
    "mean_max_rank_violation",
    "ndtw",
    "ndtw_strict",
    "onset_shift",
    "outcome_accuracy",
    "pck",
    "pck_05",
    "pck_strict",
    "policy_ranking",
    "progress_error",
    "psnr",
    "region_lpips",
    "region_lpips_frames",
    "retrieval",
    "robot_lpips",
    "robot_lpips_frames",
    "ssim",
    "trajectory_error",
    "trajectory_error_strict",
]
