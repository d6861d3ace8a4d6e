"""What the explorer draws over videos, as plain JSON: outlines of masks, keypoints, contacts, and errors by frame."""

from typing import Any

import cv2
import numpy as np

from xew.episode import Record, States, project

__all__ = ["frame_psnr", "mask_outline", "overlay_data"]

OUTLINE_TOLERANCE = 0.8
"""Distance by which an outline may pass its mask's edge [pixels]."""


def overlay_data(record: Record, states: States) -> dict[str, Any]:
    """Overlays of an episode by name; None for what the episode's source does not know.

    outlines: of every frame, polygons as flat lists x, y, x, y ... [pixels].
    keypoints: of every frame, a flat list x, y, visible (0 or 1) ...
    objects: of every frame, a flat list x, y of each object's origin; none where it is behind the camera.
    contacts: spans [arm, object, first frame, last frame], arm 0 is the left one.
    """
    unknown = record.unknown
    places = None if "object_pose" in unknown else _pixels(states)
    return {
        "outlines": None if "robot_mask" in unknown else [mask_outline(mask) for mask in states.robot_mask],
        "keypoints": None if {"keypoints", "keypoint_visible"} & set(unknown) else _keypoints(states),
        "objects": places,
        "contacts": None if "contact" in unknown else contact_spans(states.contact),
    }


def mask_outline(mask: np.ndarray) -> list[list[int]]:
    """Outlines of a mask [h w] bool and of its holes, each a flat list x, y, x, y ... [pixels]."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    polygons = (cv2.approxPolyDP(outline, OUTLINE_TOLERANCE, True) for outline in found)
    return [polygon.ravel().tolist() for polygon in polygons if len(polygon) > 1]


def _keypoints(states: States) -> list[list[float | None]]:
    marked = np.concatenate([states.keypoints, states.keypoint_visible[..., None]], -1)  # [t k 3]
    return _plain(marked)


def _pixels(states: States) -> list[list[float | None]]:
    return _plain(project(states.object_pose[..., :3], states.intrinsics, states.extrinsics)[0])


def _plain(numbers: np.ndarray) -> list[list[float | None]]:
    """Numbers [t ...] to a tenth, flat by frame; None where they are not finite, which JSON cannot say."""
    flat = np.round(numbers.reshape(len(numbers), -1).astype(float), 1)
    return [[_short(value) if np.isfinite(value) else None for value in row] for row in flat.tolist()]


def _short(value: float) -> float | int:
    return int(value) if value == int(value) else value


def contact_spans(contact: np.ndarray) -> list[list[int]]:
    """Spans [arm, object, first frame, last frame] in which an arm touches an object without a break.

    Args:
        contact: [t 2 o] bool.
    """
    spans = []
    for arm in range(contact.shape[1]):
        for thing in range(contact.shape[2]):
            change = np.flatnonzero(np.diff(contact[:, arm, thing].astype(np.int8), prepend=0, append=0))
            spans += [[arm, thing, int(first), int(end) - 1] for first, end in change.reshape(-1, 2)]
    return spans


def frame_psnr(prediction: np.ndarray, truth: np.ndarray) -> list[float | None]:
    """Peak signal-to-noise ratio [dB] of every frame of two videos [t h w 3] uint8, as many as the shorter has.

    It is `xew.metrics.psnr` to a hundredth; None where the frames are equal.
    """
    pairs = zip(prediction, truth, strict=False)
    errors = [float(np.mean((p.astype(np.float32) - q.astype(np.float32)) ** 2)) for p, q in pairs]
    return [round(10 * float(np.log10(255**2 / error)), 2) if error > 0 else None for error in errors]
