"""The default estimators in Warp kernels: the same flow, masks, points and scores as OpenCV's, on a CPU."""

import functools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from lab.calibration.matrix import grade_material
from lab.calibration.predictors import Material, delay, predict
from xew.metrics import mask_iou
from xew.metrics.backends import ReferenceMasker, Tracker, open_masker, open_tracker
from xew.metrics.episode_cache import EpisodeCache
from xew.metrics.estimators.batched import compiling, devices, flow
from xew.metrics.estimators.batched import masks as batched_masks
from xew.metrics.estimators.batched import tracks as batched_tracks
from xew.metrics.estimators.batched.flow import Search, build_pyramid, find_flow, is_large_enough
from xew.metrics.estimators.batched.masks import SEARCH as MASK_SEARCH
from xew.metrics.estimators.batched.masks import BatchedMasker
from xew.metrics.estimators.batched.tracks import SEARCH as TRACK_SEARCH
from xew.metrics.estimators.batched.tracks import BatchedTracker
from xew.metrics.estimators.masks import _flow, estimate_masks
from xew.metrics.estimators.presence import confirm_tracks
from xew.metrics.estimators.tracks import ReferenceTracker, estimate_tracks
from xew.metrics.grade import Comparison
from xew.metrics.truth import Points, Surfaces, Truth

wp = pytest.importorskip("warp")
FRAMES, HEIGHT, WIDTH = 17, 96, 128
CASES = ("truth", "2 frames late", "8 frames late", "shuffled", "frozen", "mirrored")
SCORES = ("mask_iou", "keypoint_error_strict", "trajectory_error_strict", "coverage_strict", "object_coverage_strict")
MEAN_IOU, ERRORS = 0.005, 0.03
"""Largest differences of the mean IoU and, relatively, of the strict errors that the two kinds of code may have."""


def cloth(rng: np.random.Generator, height: int, width: int, color: tuple[int, int, int]) -> np.ndarray:
    """[h w 3] uint8, soft blotches round a color."""
    blotches = cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), 2)
    return np.clip(np.array(color) + 110 * blotches[..., None], 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def truth() -> Truth:
    """A robot that goes to and fro before a wall and passes behind a thing that moves, too."""
    rng = np.random.default_rng(5)
    wall, robot, thing = (
        cloth(rng, *size, color)
        for size, color in (((HEIGHT, WIDTH), (150, 160, 150)), ((40, 26), (60, 60, 140)), ((18, 20), (200, 90, 60)))
    )
    t = np.arange(FRAMES)
    corners = {
        0: np.stack([10 + 4 * t, 20 + np.round(8 * np.sin(t / 3)).astype(int)], axis=-1),
        1: np.stack([np.maximum(90 - 4 * t, 30), np.full(FRAMES, 40)], axis=-1),
    }
    video, shown = np.repeat(wall[None], FRAMES, axis=0), np.full((FRAMES, HEIGHT, WIDTH), -1, np.int16)
    for body, looks in ((0, robot), (1, thing)):
        for frame, (x, y) in enumerate(corners[body]):
            video[frame, y : y + looks.shape[0], x : x + looks.shape[1]] = looks
            shown[frame, y : y + looks.shape[0], x : x + looks.shape[1]] = body
    points = {body: points_on(corners[body], looks.shape, shown, body) for body, looks in ((0, robot), (1, thing))}
    surfaces = Surfaces(points[0], points[1], shown, known=True)
    middle = points[1].pixels[:, 4:5], points[1].visible[:, 4:5]
    return Truth(video, shown == 0, points[0].pixels, points[0].visible, *middle, surfaces)


def points_on(corners: np.ndarray, shape: tuple[int, ...], shown: np.ndarray, body: int) -> Points:
    """Nine points of a rectangle, seen where nothing is before them."""
    grid = np.stack(np.meshgrid(*(np.linspace(0.15, 0.85, 3) * (side - 1) for side in shape[1::-1])), axis=-1)
    pixels = (corners[:, None] + grid.reshape(-1, 2)).astype(np.float32)
    column, row = np.moveaxis(np.round(pixels).astype(int), -1, 0)
    return Points(pixels, shown[np.arange(FRAMES)[:, None], row, column] == body, np.full(9, body))


@pytest.mark.parametrize("search", [MASK_SEARCH, TRACK_SEARCH], ids=["masks", "tracks"])
def test_flow_is_that_of_opencv(search: Search, truth: Truth) -> None:
    images = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in truth.rgb[[0, 1, 4, 12]]])
    images = np.concatenate([images, images[:1, ::-1]])
    pairs = np.array([[0, 1], [1, 0], [1, 2], [0, 3], [0, 4]])
    if search is MASK_SEARCH:
        expected = [_flow(images[a], images[b]) for a, b in pairs]
    else:
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        expected = [dis.calc(images[a], images[b], None) for a, b in pairs]
    found = find_flow(build_pyramid(wp.array(images, dtype=wp.uint8, device="cpu"), search), pairs).numpy()
    apart = np.linalg.norm(found - np.stack(expected), axis=-1)
    assert np.abs(expected[3]).max() > 5, "there is something to find"
    assert np.percentile(apart, 99) < 1e-3 and apart.mean() < 1e-2


def test_masks_are_those_of_opencv(truth: Truth) -> None:
    masker = BatchedMasker("cpu")
    for case in CASES:
        video = np.ascontiguousarray(predict(case, Material(truth.rgb)))
        found, expected = masker(video, truth.rgb, truth.mask), estimate_masks(video, truth.rgb, truth.mask)
        assert found.dtype == bool and (found != expected).mean() < 2e-4, case
        assert np.abs(np.asarray(mask_iou(found, truth.mask)) - mask_iou(expected, truth.mask)).max() < 5e-3, case


def test_masks_are_the_same_whatever_is_on_the_device_at_once(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    """Standing still, too, across the border of what is done together."""
    video = truth.rgb[[0, 1, 2, 3, 3, 3, 3, 7, 8, 9, 9, 11, 12, 13, 14, 15, 16]]
    expected = BatchedMasker("cpu")(video, truth.rgb, truth.mask)
    for count in (1, 5, FRAMES):
        monkeypatch.setattr(batched_masks, "FRAMES_AT_ONCE", {"cpu": count})
        np.testing.assert_array_equal(BatchedMasker("cpu")(video, truth.rgb, truth.mask), expected)


def test_points_are_found_where_opencv_finds_them(truth: Truth) -> None:
    """Also those that are hidden for some frames; they are searched for where a video is wrong."""
    surfaces = truth.surfaces
    assert surfaces is not None
    points = np.concatenate([surfaces.robot.pixels, surfaces.objects.pixels], axis=1)
    visible = np.concatenate([surfaces.robot.visible, surfaces.objects.visible], axis=1)
    assert 0.5 < visible.mean() < 1
    tracker = BatchedTracker("cpu")
    for case in CASES:
        video = np.ascontiguousarray(predict(case, Material(truth.rgb)))
        found, expected = (track(video, truth.rgb, points, visible) for track in (tracker, estimate_tracks))
        assert found.dtype == np.float32 and not np.isfinite(found[~visible]).any()
        lost, expected_lost = (~np.isfinite(tracks).all(axis=-1) for tracks in (found, expected))
        assert (lost != expected_lost).mean() < 0.01, case
        apart = np.linalg.norm(found - expected, axis=-1)[~lost & ~expected_lost]
        assert np.percentile(apart, 95) < 0.05 and apart.mean() < 0.1, case


def test_places_of_other_things_are_told_as_opencv_tells_them(truth: Truth) -> None:
    surfaces = truth.surfaces
    assert surfaces is not None and surfaces.body_id is not None
    points, visible = surfaces.robot.pixels, surfaces.robot.visible
    known = truth.rgb, points, visible, surfaces.body_id, np.zeros(9, int)
    tracker = BatchedTracker("cpu")
    assert hasattr(tracker, "confirm")
    video = np.ascontiguousarray(predict("8 frames late", Material(truth.rgb)))
    tracker(video, truth.rgb, points, visible)
    apart = np.random.default_rng(0).normal(0, 8, points.shape).astype(np.float32)
    found = np.where(visible[..., None], points + apart, np.nan)
    expected = confirm_tracks(found, video, *known)
    lost, were_lost = np.isnan(expected).any(axis=-1), np.isnan(found).any(axis=-1)
    assert 0.1 < (lost & ~were_lost).sum() / (~were_lost).sum() < 0.9
    np.testing.assert_array_equal(tracker.confirm(found, video, *known), expected)
    np.testing.assert_array_equal(tracker.confirm(found, video[:, ::-1], *known), confirm_tracks(found, video[:, ::-1], *known))


def test_scores_of_the_predictors_are_the_same(truth: Truth) -> None:
    opencv, warp = (ReferenceMasker(), ReferenceTracker()), (BatchedMasker("cpu"), BatchedTracker("cpu"))
    graded = {
        name: pd.DataFrame(grade_material(Material(truth.rgb), truth, *estimators, SCORES, CASES))
        for name, estimators in (("opencv", opencv), ("warp", warp))
    }
    expected, found = (rows.set_index(["metric", "case"])["value"].unstack() for rows in graded.values())
    assert expected.loc["keypoint_error_strict"].max() > 10 > 1 > expected.loc["keypoint_error_strict"].min()
    assert (found - expected).loc["mask_iou"].abs().mean() < MEAN_IOU
    for name in SCORES[1:]:
        np.testing.assert_allclose(found.loc[name], expected.loc[name], rtol=ERRORS, atol=0.02, err_msg=name)


@pytest.mark.parametrize("open_", [ReferenceTracker, lambda: BatchedTracker("cpu")], ids=["opencv", "warp"])
def test_points_of_all_kinds_are_found_in_one_pass_as_one_kind_alone(open_: Callable[[], Tracker], truth: Truth) -> None:
    tracker, asked = open_(), []

    def one_kind(*arguments: np.ndarray) -> np.ndarray:
        """The same tracker as one that may not be asked for all at once."""
        asked.append(arguments[2].shape[1])
        return tracker(*arguments)

    video = np.ascontiguousarray(predict("2 frames late", Material(truth.rgb)))
    assert tracker.pointwise
    together, alone = (Comparison(video, EpisodeCache(truth), estimate_masks, some) for some in (tracker, one_kind))
    for kind in together.points:
        np.testing.assert_array_equal(together.track(kind), alone.track(kind))
    assert asked == [9, 1, 18], "links, the object, and points on surfaces"


def test_a_tracker_gives_the_same_whatever_it_was_asked_before(truth: Truth) -> None:
    late, later = delay(truth.rgb, 2), delay(truth.rgb, 4)
    robot = truth.keypoints, truth.keypoint_visible
    tracker = BatchedTracker("cpu")
    asked = [(late, truth.rgb, *robot), (later, truth.rgb, *robot), (late, later, *robot), (late, truth.rgb, *robot)]
    found = [tracker(*arguments) for arguments in asked]
    for tracks, arguments in zip(found, asked, strict=True):
        np.testing.assert_array_equal(tracks, BatchedTracker("cpu")(*arguments))
    assert not np.array_equal(found[0], found[1], equal_nan=True)
    nothing = tracker(late, truth.rgb, truth.keypoints[:, :0], truth.keypoint_visible[:, :0])
    assert nothing.shape == (FRAMES, 0, 2)


@pytest.mark.parametrize("size", [(40, 50), (96, 127), (7, 9)])
def test_images_that_the_kernels_are_not_made_for_are_left_to_opencv(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    prediction, target = rng.integers(0, 255, (2, 3, *size, 3), dtype=np.uint8)
    points, visible = rng.uniform(2, 6, (3, 4, 2)).astype(np.float32), np.ones((3, 4), bool)
    assert is_large_enough(size, TRACK_SEARCH) == (size == (96, 127))
    if min(size) >= 12:  # the least that OpenCV's flow takes
        tracks = BatchedTracker("cpu")(prediction, target, points, visible)
        np.testing.assert_array_equal(tracks, estimate_tracks(prediction, target, points, visible))


def test_the_default_is_opencv_where_there_is_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "find_gpu", lambda: None)
    assert type(open_masker("default")).__name__ == "ReferenceMasker"
    assert type(open_tracker("default")).__name__ == "ReferenceTracker"
    monkeypatch.setattr(devices, "find_gpu", lambda: "cpu")
    assert isinstance(open_masker("default"), BatchedMasker) and isinstance(open_tracker("default"), BatchedTracker)


def test_a_process_takes_the_first_gpu_that_it_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    gpus = [type("Device", (), {"alias": f"cuda:{i}"}) for i in range(2)]
    begun: list[object] = []
    monkeypatch.setattr(wp, "get_cuda_devices", lambda: gpus)
    monkeypatch.setattr(wp, "get_stream", begun.append)
    assert devices.find_gpu() == "cuda:0"
    assert begun == [gpus[0]], "its context is made while no other thread can find it half made"
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    assert devices.find_gpu() is None


def test_kernels_that_are_compiled_ahead_are_those_that_are_launched(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    launched: dict[str, set[int]] = {}

    def note(launch: Any, kernel: Any, *arrays: Any, **named: Any) -> None:
        options = getattr(launch, "keywords", {}) | named
        launched.setdefault(kernel.module.name, set()).add(options.get("block_dim", compiling.DEFAULT_THREADS))
        launch(kernel, *arrays, **named)

    for place, name in ((wp, "launch"), (wp, "launch_tiled"), (flow, "_launch"), (batched_tracks, "_launch")):
        monkeypatch.setattr(place, name, functools.partial(note, getattr(place, name)))
    video, surfaces = np.ascontiguousarray(predict("8 frames late", Material(truth.rgb))), truth.surfaces
    assert surfaces is not None
    BatchedMasker("cpu")(video, truth.rgb, truth.mask)
    assert launched.keys() == set(compiling.OF_MASKS)
    BatchedTracker("cpu")(video, truth.rgb, surfaces.robot.pixels, surfaces.robot.visible)
    assert launched.keys() == set(compiling.OF_TRACKS)
    assert launched == {name: {compiling.THREADS[name]} for name in compiling.OF_TRACKS}


def test_a_module_is_missing_until_the_cache_holds_it_for_the_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(wp, "get_cuda_devices", lambda: [SimpleNamespace(get_cuda_compile_arch=lambda: 90)])
    module = compiling.OF_MASKS[0]
    name = wp.get_module(module).get_module_identifier(compiling.THREADS[module])
    (tmp_path / name).mkdir()
    for file, missing in (("sm80.cubin", True), ("sm90.cubin", False)):
        (tmp_path / name / f"{name}.{file}").touch()
        assert (module in compiling.missing_kernels(compiling.THREADS)) == missing
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    assert compiling.missing_kernels(compiling.THREADS) == [], "nothing is compiled without a GPU"
