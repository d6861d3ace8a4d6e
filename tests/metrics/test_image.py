"""PSNR and SSIM against scikit-image, on every kind of frame that has broken such code before."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity

from xew.metrics import exact_frames, psnr, ssim

rng = np.random.default_rng(0)


def noise(t: int = 2, h: int = 48, w: int = 64) -> np.ndarray:
    return rng.integers(0, 256, (t, h, w, 3), dtype=np.uint8)


def near(video: np.ndarray, spread: float) -> np.ndarray:
    return np.clip(video + rng.normal(0, spread, video.shape), 0, 255).astype(np.uint8)


def bright(h: int = 240, w: int = 320) -> np.ndarray:
    return near(np.full((1, h, w, 3), 252, np.uint8), 0.7)


VIDEO = noise()
PAIRS = {
    "unrelated": (VIDEO, noise()),
    "near": (VIDEO, near(VIDEO, 4)),
    "flat": (np.full_like(VIDEO, 200), np.full_like(VIDEO, 203)),
    "flat and bright": (bright(), bright()),
    "black and white": (np.zeros_like(VIDEO), np.full_like(VIDEO, 255)),
    "odd sides": (noise(2, 37, 51), noise(2, 37, 51)),
    "smallest": (noise(3, 7, 7), noise(3, 7, 7)),
    "large and opposite": (np.zeros((1, 480, 640, 3), np.uint8), np.full((1, 480, 640, 3), 255, np.uint8)),
    "one level in one pixel": (VIDEO, VIDEO ^ (np.arange(VIDEO.size).reshape(VIDEO.shape) % VIDEO[0].size == 0)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_ssim_equals_scikit_image(name: str) -> None:
    prediction, target = PAIRS[name]
    expected = [structural_similarity(t, p, channel_axis=-1, data_range=255) for p, t in zip(prediction, target, strict=True)]
    np.testing.assert_allclose(ssim(prediction, target), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", PAIRS)
def test_psnr_equals_scikit_image(name: str) -> None:
    prediction, target = PAIRS[name]
    expected = [peak_signal_noise_ratio(t, p) for p, t in zip(prediction, target, strict=True)]
    np.testing.assert_allclose(psnr(prediction, target), expected, rtol=1e-6, atol=1e-6)


def test_an_exact_frame_has_the_most_that_an_inexact_one_can_have_whatever_the_others_are() -> None:
    target = np.zeros((3, 240, 320, 3), np.uint8)
    nearest = target.copy()
    nearest[0, 5, 5, 1] = 1
    nearest[2] = 128
    assert mean_squared_error(nearest[0], target[0]) == pytest.approx(1 / target[0].size)
    assert exact_frames(nearest, target).tolist() == [False, True, False]
    np.testing.assert_allclose(psnr(target, target), 101.7556, atol=1e-4)
    np.testing.assert_allclose(
        psnr(nearest, target), [101.7556, 101.7556, peak_signal_noise_ratio(target[2], nearest[2])], atol=1e-4
    )


def test_identical_videos_have_ssim_one() -> None:
    for video in (noise(), noise(1, 33, 47), np.zeros((1, 9, 9, 3), np.uint8), bright()):
        np.testing.assert_array_equal(ssim(video, video), 1)


def test_frames_do_not_depend_on_their_neighbors_or_the_chunk() -> None:
    prediction, target = noise(5), noise(5)
    order = rng.permutation(5)
    np.testing.assert_array_equal(ssim(prediction, target)[order], ssim(prediction[order], target[order]))
    for chunk in (2, 64):
        for metric in (psnr, ssim):
            np.testing.assert_allclose(metric(prediction, target), metric(prediction, target, chunk=chunk), rtol=1e-6)
    with pytest.raises(ValueError, match="chunk is 0"):
        ssim(prediction, target, chunk=0)


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_as_a_loss_on_floats_it_agrees_with_uint8_and_its_gradient_is_finite(metric: object) -> None:
    prediction, target = PAIRS["near"]
    p, t = (jnp.asarray(video, jnp.float32) / 255 for video in (prediction, target))
    np.testing.assert_allclose(metric(p, t), metric(prediction, target), rtol=1e-4)
    for start in (p, t):
        gradient = jax.grad(lambda x: jnp.sum(metric(x, t)))(start)
        assert np.isfinite(gradient).all()


@pytest.mark.parametrize(
    ("prediction", "target", "error", "word"),
    [
        (noise(2), noise(3), ValueError, "one shape"),
        (noise()[0], noise()[0], ValueError, "t h w 3"),
        (noise(0), noise(0), ValueError, "no frames"),
        (noise(1, 6, 9), noise(1, 6, 9), ValueError, "at least 7"),
        (noise(), noise().astype(np.int32), TypeError, "uint8"),
        (noise(), noise() / np.float32(255), TypeError, "floating"),
    ],
)
def test_what_cannot_be_compared_is_an_error(prediction: np.ndarray, target: np.ndarray, error: type, word: str) -> None:
    with pytest.raises(error, match=word):
        ssim(prediction, target)
