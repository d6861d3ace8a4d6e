"""Presence: whether a tracked place shows the body of its point, judged by the body's own pixels around the point.

A tracker compares all pixels around a point. Around a point on a held object most of them show the hand, so a video without the
object looks much like the true one. Here only pixels of the body count, which the ground truth gives.
"""

import numpy as np

from xew.metrics.estimators.images import is_inside, sample, soften

REACH = 8
"""Half the side of the square round a point [pixels] in which pixels of its body are compared."""
SOFTNESS = 1.5
"""Standard deviation [pixels] of the blur of what is compared, so sharpness and grain do not count."""
OTHER_COLOR = 40
"""Least difference [levels of a channel] that is another color, more than shadows and codecs make."""
SAME_COLOR = 20
"""Largest difference [levels of a channel] that is the same color, that of what stands still."""


def confirm_tracks(
    tracks: np.ndarray,
    prediction: np.ndarray,
    target: np.ndarray,
    points: np.ndarray,
    visible: np.ndarray,
    body_id: np.ndarray,
    body: np.ndarray,
) -> np.ndarray:
    """Tracks without the places that do not show the point's body.

    The body's pixels around the true point are compared with those around the tracked place. A place is dropped if more than
    half have another color, or if more than half show what the true frame has there of another body.

    Args:
        tracks: [t k 2] float32 pixels, NaN where lost.
        prediction, target: [t h w 3] uint8, predicted and true video.
        points: [t k 2] float32 pixels, true positions.
        visible: [t k] bool, where the true points are visible.
        body_id: [t h w] int, the body that a pixel of the target shows.
        body: [k] int, the body that each point lies on.

    Returns:
        [t k 2] float32, NaN where lost or dropped.
    """
    confirmed = tracks.copy()
    reach = np.arange(-REACH, REACH + 1)
    around = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(1, -1, 2).astype(np.float32)
    for t, (frame, true_frame) in enumerate(zip(prediction, target, strict=True)):
        index = np.flatnonzero(visible[t] & np.isfinite(tracks[t]).all(axis=-1))
        if not len(index):
            continue
        places, true_places = (array[t, index, None] + around for array in (tracks, points))
        own, same_body = (_read_body(body_id[t], at) == body[index, None] for at in (true_places, places))
        counted = own & is_inside(places, frame) & is_inside(true_places, frame)
        soft, true_soft = (soften(image, SOFTNESS).astype(np.float32) for image in (frame, true_frame))
        seen = sample(soft, places)
        differs = np.abs(seen - sample(true_soft, true_places)).max(axis=-1) > OTHER_COLOR
        stands = ~same_body & (np.abs(seen - sample(true_soft, places)).max(axis=-1) <= SAME_COLOR)
        most = counted.sum(axis=1) / 2
        wrong = ((counted & differs).sum(axis=1) > most) | ((counted & stands).sum(axis=1) > most)
        confirmed[t, index[wrong]] = np.nan
    return confirmed


def _read_body(body_id: np.ndarray, places: np.ndarray) -> np.ndarray:
    """[n p] the body that the pixel of each place [n p 2] shows in one frame; of places outside, the nearest pixel's."""
    column, row = np.moveaxis(np.round(places).astype(int), -1, 0)
    height, width = body_id.shape
    return body_id[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
