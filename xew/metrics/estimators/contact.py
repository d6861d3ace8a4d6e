"""A diagnostic: the frames in which a hand touches an object in a predicted video, as far as the image plane tells.

A hand and an object are said to touch where their tracked points are nearer than the distance that best tells touching
from not touching in the true episode itself. The paper computes such a score and leaves it out of its suite, because
contact timing in predicted video is not reliable enough; so do we.
"""

import numpy as np


def predicted_contact(distance: np.ndarray, true_distance: np.ndarray, true_contact: np.ndarray) -> np.ndarray:
    """Which pairs touch in a prediction.

    Args:
        distance: [t c] pixels between the two points of each pair in the prediction, NaN where one is lost.
        true_distance: [t c] the same in the truth, NaN where one is not seen.
        true_contact: [t c] bool, recorded by the simulation.

    Returns:
        [t c] bool; a point that is lost touches nothing.
    """
    reach = np.array([touching_distance(*pair) for pair in zip(true_distance.T, true_contact.T, strict=True)])
    return np.nan_to_num(distance, nan=np.inf) <= reach


def touching_distance(distance: np.ndarray, contact: np.ndarray) -> float:
    """The distance [pixels] up to which `contact` [t] is called by `distance` [t] with the best F1; -1 where it never is."""
    seen = np.isfinite(distance)
    order = np.argsort(distance[seen], kind="stable")
    sorted_distance, hit = distance[seen][order], contact[seen][order]
    if not hit.any():
        return -1.0
    f1 = 2 * np.cumsum(hit) / (np.arange(1, len(hit) + 1) + hit.sum())
    last = np.append(sorted_distance[1:] > sorted_distance[:-1], True)  # a threshold takes all frames of one distance
    return float(sorted_distance[np.argmax(np.where(last, f1, -1))])
