"""Overlays of the explorer as plain JSON: outlines of masks, keypoints, contacts, and errors by frame."""

from typing import Any

import cv2
import numpy as np

from xew.episode import Record, States, project

__all__ = ["frame_psnr", "mask_outline", "overlay_data"]

OUTLINE_TOLERANCE = 0.8
"""Largest distance between an outline and its mask's edge [pixels]."""


def overlay_data(record: Record, states: States) -> dict[str, Any]:
    """Overlays of an episode by name; None for unknown arrays of an imported episode.

    outlines: for every frame, polygons as flat lists x, y, x, y ... [pixels].
    keypoints: for every frame, a flat list x, y, visible (0 or 1) ...
    objects: for every frame, a flat list x, y of each object's origin; None behind the camera.
    contacts: spans [arm, object, first frame, last frame], arm 0 is the left one.
    """
    unknown = record.unknown
    marked = np.concatenate([states.keypoints, states.keypoint_visible[..., None]], -1)  # [t k 3]
    origins = project(states.object_pose[..., :3], states.intrinsics, states.extrinsics)[0]
    return {
        "outlines": None if "robot_mask" in unknown else [mask_outline(mask) for mask in states.robot_mask],
        "keypoints": None if {"keypoints", "keypoint_visible"} & set(unknown) else _plain(marked),
        "objects": None if "object_pose" in unknown else _plain(origins),
        "contacts": None if "contact" in unknown else contact_spans(states.contact),
    }


def mask_outline(mask: np.ndarray) -> list[list[int]]:
    """Outlines of a mask [h w] bool and of its holes, each a flat list x, y, x, y ... [pixels]."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    polygons = (cv2.approxPolyDP(outline, OUTLINE_TOLERANCE, True) for outline in outlines)
    return [polygon.ravel().tolist() for polygon in polygons if len(polygon) > 1]


def _plain(numbers: np.ndarray) -> list[list[float | None]]:
    """Numbers [t ...] rounded to a tenth, flat by frame; None for numbers that are not finite."""
    flat = np.round(numbers.reshape(len(numbers), -1).astype(float), 1)
    return [[(int(v) if v.is_integer() else v) if np.isfinite(v) else None for v in row] for row in flat.tolist()]


def contact_spans(contact: np.ndarray) -> list[list[int]]:
    """Spans [arm, object, first frame, last frame] of continuous contact.

    Args:
        contact: [t 2 o] bool.
    """
    spans = []
    for arm in range(contact.shape[1]):
        for item in range(contact.shape[2]):
            change = np.flatnonzero(np.diff(contact[:, arm, item].astype(np.int8), prepend=0, append=0))
            spans += [[arm, item, int(first), int(end) - 1] for first, end in change.reshape(-1, 2)]
    return spans


def frame_psnr(prediction: np.ndarray, truth: np.ndarray) -> list[float | None]:
    """Peak signal-to-noise ratio [dB] of every frame of two videos [t h w 3] uint8, as long as the shorter one.

    It is `xew.metrics.psnr` rounded to a hundredth; None for equal frames.
    """
    pairs = zip(prediction, truth, strict=False)
    errors = [float(np.mean((p.astype(np.float32) - q.astype(np.float32)) ** 2)) for p, q in pairs]
    return [round(10 * float(np.log10(255**2 / error)), 2) if error > 0 else None for error in errors]
