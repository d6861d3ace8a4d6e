"""IoU and boundary F1 against plain loops, SciPy's exact distance transform and OpenCV's morphology."""

from collections.abc import Callable

import cv2
import jax
import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt

from xew.metrics import boundary_f1, mask_iou

rng = np.random.default_rng(1)


def blobs(t: int = 3, h: int = 40, w: int = 53, share: float = 0.01) -> np.ndarray:
    seeds = rng.random((t, h, w)) < share
    return np.stack([binary_dilation(seed, iterations=3) for seed in seeds])


def brute_edge(mask: np.ndarray) -> np.ndarray:
    edge = np.zeros_like(mask)
    for y, x in zip(*np.nonzero(mask), strict=True):
        edge[y, x] = not mask[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].all()
    return edge


def brute_f1(prediction: np.ndarray, target: np.ndarray, tolerance: float) -> float:
    p, t = brute_edge(prediction), brute_edge(target)
    if not p.any() and not t.any():
        return float((prediction == target).all())
    if not p.any() or not t.any():
        return 0.0
    precision = (distance_transform_edt(~t)[p] <= tolerance).mean()
    recall = (distance_transform_edt(~p)[t] <= tolerance).mean()
    return 0.0 if precision + recall == 0 else 2 * precision * recall / (precision + recall)


@pytest.mark.parametrize("tolerance", [0, 1, 2, 2.5, 5, 9, 17])
@pytest.mark.parametrize("size", [(40, 53), (5, 5), (1, 9), (64, 31)])
def test_boundary_f1_equals_brute_force(size: tuple[int, int], tolerance: float) -> None:
    prediction, target = blobs(4, *size, share=0.03), blobs(4, *size, share=0.03)
    expected = [brute_f1(p, t, tolerance) for p, t in zip(prediction, target, strict=True)]
    np.testing.assert_allclose(boundary_f1(prediction, target, tolerance=tolerance), expected, atol=1e-6)


def opencv_scores(prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """As projects write it: contour = mask less its erosion, matched = inside the other contour's dilation."""
    disc = np.uint8([[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]])
    p, t = prediction.astype(np.uint8), target.astype(np.uint8)
    edge_p, edge_t = (mask - cv2.erode(mask, np.ones((3, 3), np.uint8)) for mask in (p, t))
    precision = np.count_nonzero(edge_p & cv2.dilate(edge_t, disc)) / np.count_nonzero(edge_p)
    recall = np.count_nonzero(edge_t & cv2.dilate(edge_p, disc)) / np.count_nonzero(edge_t)
    return np.count_nonzero(p & t) / np.count_nonzero(p | t), 2 * precision * recall / (precision + recall)


@pytest.mark.parametrize("size", [(240, 320), (61, 47), (300, 40)])
def test_both_equal_opencv(size: tuple[int, int]) -> None:
    target = blobs(2, *size)
    prediction = target ^ blobs(2, *size, share=0.002)
    iou, f1 = zip(*(opencv_scores(p, t) for p, t in zip(prediction, target, strict=True)), strict=True)
    np.testing.assert_allclose(mask_iou(prediction, target), iou, atol=1e-6)
    np.testing.assert_allclose(boundary_f1(prediction, target), f1, atol=1e-6)


@pytest.mark.parametrize("metric", [mask_iou, boundary_f1])
def test_inside_a_jit_and_a_vmap_are_the_same_numbers(metric: Callable[..., jax.Array]) -> None:
    prediction, target = blobs(), blobs()
    alone = metric(prediction, target)
    np.testing.assert_array_equal(jax.jit(metric)(prediction, target), alone)
    np.testing.assert_array_equal(jax.vmap(metric)(np.stack([prediction, target]), np.stack([target, target]))[0], alone)


def test_frames_do_not_depend_on_their_neighbors() -> None:
    prediction, target, order = blobs(5), blobs(5), rng.permutation(5)
    for metric in (mask_iou, boundary_f1):
        np.testing.assert_array_equal(metric(prediction, target)[order], metric(prediction[order], target[order]))


def test_mask_iou_equals_counting() -> None:
    prediction, target = blobs(), blobs()
    expected = [np.count_nonzero(p & t) / np.count_nonzero(p | t) for p, t in zip(prediction, target, strict=True)]
    np.testing.assert_allclose(mask_iou(prediction, target), expected, atol=1e-6)


@pytest.mark.parametrize("metric", [mask_iou, boundary_f1])
def test_identity_empty_and_full(metric: object) -> None:
    some, none, full = blobs(1), np.zeros((1, 40, 53), bool), np.ones((1, 40, 53), bool)
    for mask in (some, none, full):
        assert metric(mask, mask)[0] == 1
    assert metric(none, some)[0] == metric(some, none)[0] == 0
    assert metric(full, none)[0] == metric(none, full)[0] == 0


def test_masks_touching_the_border_have_no_contour_there() -> None:
    half = np.zeros((1, 20, 20), bool)
    half[:, :, :10] = True
    wider = np.zeros((1, 20, 20), bool)
    wider[:, :, :12] = True
    assert boundary_f1(wider, half, tolerance=2)[0] == 1
    assert boundary_f1(wider, half, tolerance=1)[0] == 0


@pytest.mark.parametrize("metric", [mask_iou, boundary_f1])
def test_it_is_symmetric_and_falls_as_a_mask_moves_away(metric: object) -> None:
    target = np.zeros((1, 30, 60), bool)
    target[:, 8:20, 10:22] = True
    values = [float(metric(np.roll(target, shift, axis=2), target)[0]) for shift in (0, 3, 6, 12)]
    assert values == sorted(values, reverse=True) and values[0] == 1 and values[1] < 1
    a, b = blobs(), blobs()
    np.testing.assert_allclose(metric(a, b), metric(b, a), atol=1e-7)


def test_masks_that_are_not_bool_are_an_error() -> None:
    with pytest.raises(TypeError, match="uint8"):
        mask_iou(blobs().astype(np.uint8), blobs())
    with pytest.raises(ValueError, match="one shape"):
        boundary_f1(blobs(2), blobs(3))
    with pytest.raises(ValueError, match="at least 0"):
        boundary_f1(blobs(), blobs(), tolerance=-1)
