"""The scores of one video, compared with its episode by estimators and metrics.

grades = grade(Comparison(video, EpisodeCache(truth), masker, tracker), ("psnr", "mask_iou"))
"""

import functools
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from xew.metrics import METRICS
from xew.metrics.backends import Masker, Tracker
from xew.metrics.episode_cache import EpisodeCache, GradedFrames, cut_blocks, is_on_cpu
from xew.metrics.estimators.images import equal_frames
from xew.metrics.estimators.presence import confirm_tracks
from xew.metrics.metric import fill_up
from xew.metrics.perceptual import SMALLEST_SIDE, Box, lpips, region_lpips_frames, robot_lpips_frames, union_box
from xew.metrics.truth import OF_OUTCOME, Points, Truth

TRACK_BLOCK, POINT_BLOCK = 64, 32
"""Numbers of frames and points that tracks are filled up to multiples of, so videos of all lengths and robots share a few
programs: compiling one takes seconds, running it milliseconds."""
ON_SURFACES = ("robot_points", "object_points")
"""Kinds of points that are tracked in one pass, by any tracker."""
MASKED = ("region", "robot", "bodies")
"""Kinds of inputs that are two videos and true masks."""
JUDGED = tuple(sorted(OF_OUTCOME))
"""Kinds of inputs that rest on `Truth.outcome`, which asks for points on objects."""


@dataclass(frozen=True)
class Grades:
    """The scores of one video."""

    values: dict[str, float]
    """Values by metric; NaN where one is not defined, such as the error of keypoints of which none is ever seen."""
    curves: dict[str, np.ndarray]
    """Values by metric and graded frame, [t] float32, NaN where a frame has no value; none for metrics of whole paths."""
    exact_frames: int
    """Number of graded frames that equal the truth in every byte (their PSNR is the cap's)."""


def input_kind(name: str) -> str:
    """The kind of arrays that a metric compares, a key of `truth.NEEDS`."""
    metric = METRICS[name]
    if metric.inputs != "track":
        return metric.inputs
    if metric.points == "surfaces":
        return "object_points" if metric.dimension == "objects" else "robot_points"
    return "objects" if metric.dimension == "objects" else "keypoints"


@dataclass(frozen=True)
class Comparison:
    """A prediction, the episode that it predicts, and the estimators of the robot and its points, which see all frames."""

    prediction: np.ndarray
    """[t h w 3] uint8, of the true video's shape."""
    episode: EpisodeCache
    """The episode, the same object for all predictions of it."""
    masker: Masker
    tracker: Tracker
    estimator_video: np.ndarray | None = None
    """[t h w 3] uint8, the video that the estimators see; the prediction where left out."""
    _tracks: dict[str, np.ndarray] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def truth(self) -> Truth:
        """The episode's truth."""
        return self.episode.truth

    @cached_property
    def video(self) -> GradedFrames:
        """The graded frames of the prediction."""
        return GradedFrames(self.prediction[self.episode.first :])

    def track_options(self, kind: str) -> dict[str, np.ndarray]:
        """The values of `metric.OPTIONS`, scalars, [t] and [k], for points of a kind, filled up as their tracks are."""
        height, width = self.prediction.shape[1:3]
        first, points = self.episode.first, self.points[kind]
        seen = points.visible[first:].any(axis=0)
        numbers = {name: _numbers(points, name)[seen] for name in ("body", "finger")}
        return {
            "side": np.asarray(math.sqrt(height * width), np.float32),
            "largest": np.asarray(math.hypot(height, width), np.float32),
            "diagonal": fill_up(self.truth.keypoint_diagonal[first:], 0, TRACK_BLOCK, 0),
            "frames": np.asarray(len(self.prediction) - first, np.int32),
            **{name: fill_up(values, 0, POINT_BLOCK, -1) for name, values in numbers.items()},
        }

    @cached_property
    def points(self) -> dict[str, Points]:
        """Points of the truth that a tracker can be asked for, by `input_kind`; on surfaces where it was read with them."""
        truth = self.truth
        known = {
            "keypoints": Points(truth.keypoints, truth.keypoint_visible),
            "objects": Points(truth.objects, truth.object_visible),
        }
        if truth.surfaces is not None:
            known |= {"robot_points": truth.surfaces.robot, "object_points": truth.surfaces.objects}
            if truth.outcome is not None and truth.surfaces.resting is not None:
                known |= {"resting_points": truth.surfaces.resting}
        return known

    @cached_property
    def tracked_poses(self) -> np.ndarray:
        """Poses [t p 4 4] of the parts of `Truth.outcome` in the prediction. The truth was read with its outcome."""
        assert self.truth.outcome is not None, "asked for by read_truth"
        kinds = ("object_points", "resting_points")
        tracks = np.concatenate([self.track(kind) for kind in kinds], axis=1)
        return self.truth.outcome.poses(tracks, np.concatenate([self.points[kind].visible for kind in kinds], axis=1))

    @cached_property
    def judged_poses(self) -> np.ndarray:
        """Poses [t p 4 4] of the parts by which the outcome of the prediction is judged.

        Objects are where a variant of the commands has them, if the prediction shows them there at the end; else, or if the
        scene has no other commands, where the tracker finds them.
        """
        outcome = self.truth.outcome
        shown = outcome.variants.find_shown(self.prediction) if outcome is not None and outcome.variants is not None else None
        if outcome is None or shown is None:
            return self.tracked_poses
        poses = outcome.poses_of(shown)
        return poses[np.minimum(np.arange(len(self.prediction)), len(poses) - 1)]

    def estimate_masks(self) -> np.ndarray:
        """Robot masks [t h w] bool of all frames of the prediction."""
        return self.masker(*self._videos_for(self.masker), self.truth.mask)

    def track(self, kind: str) -> np.ndarray:
        """Tracks of the points of a kind [t k 2] pixels, NaN where lost or hidden in the truth.

        Raises ValueError if the truth was read without these points.
        """
        if kind not in self.points:
            raise ValueError("the truth has no points on surfaces; ask read_truth for 'robot_points' and 'object_points'.")
        if kind not in self._tracks:
            kinds = ON_SURFACES if kind in ON_SURFACES else (kind,)
            self._tracks.update(self._track(tuple(self.points) if getattr(self.tracker, "pointwise", False) else kinds))
        return self._tracks[kind]

    @property
    def _estimator_input(self) -> np.ndarray:
        return self.prediction if self.estimator_video is None else self.estimator_video

    @cached_property
    def _alike(self) -> tuple[np.ndarray, np.ndarray]:
        """The predicted and the true video in the same colors."""
        return self.episode.appearance.match(self._estimator_input)

    def _videos_for(self, estimator: object) -> tuple[np.ndarray, np.ndarray]:
        """The predicted and the true video as an estimator takes them."""
        return self._alike if getattr(estimator, "compares_colors", False) else (self._estimator_input, self.truth.rgb)

    def _track(self, kinds: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Tracks [t k 2] by kind, found in one call; places without the color of the point's body are dropped."""
        points = [self.points[kind] for kind in kinds]
        pixels, visible = (np.concatenate([getattr(some, name) for some in points], axis=1) for name in ("pixels", "visible"))
        seen = visible.any(axis=0)
        tracks = np.full(pixels.shape, np.nan, np.float32)
        if seen.any():
            tracks[:, seen] = self.tracker(*self._videos_for(self.tracker), np.nan_to_num(pixels[:, seen]), visible[:, seen])
        if self.truth.surfaces is not None and self.truth.surfaces.body_id is not None:
            body = np.concatenate([_numbers(some, "body") for some in points])
            on_body = seen & (body >= 0)
            places = np.nan_to_num(pixels[:, on_body]), visible[:, on_body]
            confirm = getattr(self.tracker, "confirm", confirm_tracks)
            body_id = self.truth.surfaces.body_id
            tracks[:, on_body] = confirm(tracks[:, on_body], *self._alike, *places, body_id, body[on_body])
        ends = np.cumsum([some.visible.shape[1] for some in points])
        return dict(zip(kinds, np.split(tracks, ends[:-1], axis=1), strict=True))


def _numbers(points: Points, name: str) -> np.ndarray:
    """[k] int32, the body or finger that each point lies on, -1 where that is not known."""
    numbers = getattr(points, name)
    return np.full(points.visible.shape[1], -1, np.int32) if numbers is None else numbers.astype(np.int32)


def grade(comparison: Comparison, metrics: Collection[str]) -> Grades:
    """Scores of one predicted video by the metrics of these names."""
    inputs = {kind: INPUTS[kind](comparison) for kind in sorted({input_kind(name) for name in metrics})}
    values: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {}
    of_features = _curves_of_features(comparison, metrics, inputs)
    of_tracks = _grade_tracks(comparison, metrics, inputs)
    for name in metrics:
        arrays = inputs[input_kind(name)]
        if arrays is None:
            values[name] = math.nan
        elif name in of_tracks:
            values[name], curve = of_tracks[name]
            curves |= {} if curve is None else {name: curve}
        elif METRICS[name].curve is None:
            values[name] = float(METRICS[name].function(*arrays))
        else:
            curves[name] = of_features[name] if name in of_features else _curve(comparison, name, arrays)
            values[name] = _mean_of_known(curves[name])
    prediction, target = _video(comparison)
    return Grades(values, curves, int(equal_frames(prediction, target).sum()))


Arrays = tuple[np.ndarray, ...]
Inputs = Mapping[str, Arrays | None]


def _video(c: Comparison) -> Arrays:
    return c.video.frames, c.episode.target.frames


def _mask(c: Comparison) -> Arrays:
    return c.estimate_masks()[c.episode.first :], c.truth.mask[c.episode.first :]


def _masked(kind: str, c: Comparison) -> Arrays | None:
    """The two videos and the true masks of a kind, an attribute of `EpisodeCache`; None where the truth has none."""
    masks: GradedFrames | None = getattr(c.episode, kind)
    return None if masks is None else (*_video(c), masks.frames)


def _tracks(kind: str, c: Comparison) -> Arrays | None:
    """Tracked points, true points and visibility of those that are ever seen; None where none is, whatever the prediction."""
    first, tracks, points = c.episode.first, c.track(kind), c.points[kind]
    pixels, visible = np.nan_to_num(points.pixels[first:]), points.visible[first:]
    seen = visible.any(axis=0)
    return (tracks[first:, seen], pixels[:, seen], visible[:, seen]) if seen.any() else None


def _outcome(c: Comparison) -> Arrays | None:
    """Judged and true progress [1] in the last frame; None where there is no judge of the episode."""
    outcome, last = c.truth.outcome, len(c.prediction) - 1
    if outcome is None or not outcome.is_judged:
        return None
    judged, true = outcome.progress(c.judged_poses[last], last), outcome.true_progress(last)
    return np.array([judged], np.float32), np.array([true], np.float32)


def _variants(c: Comparison) -> Arrays | None:
    """Distances [k] of objects from where they are under k variants of the commands, and 0 for the own variant, else 1."""
    outcome = c.truth.outcome
    if outcome is None or not outcome.is_judged or outcome.variants is None:
        return None
    frames = slice(c.episode.first, len(c.prediction))
    return outcome.distances(c.tracked_poses, frames), _others(len(outcome.variants), outcome.own)


def _variant_videos(c: Comparison) -> Arrays | None:
    """LPIPS [k] from the true videos of k variants of the commands, in moving regions; the rest as of `_variants`."""
    outcome = c.truth.outcome
    if outcome is None or outcome.variants is None or min(c.prediction.shape[1:3]) < SMALLEST_SIDE:
        return None
    return outcome.variants.perceptual_distances(c.prediction), _others(len(outcome.variants), outcome.own)


def _others(count: int, own: int) -> np.ndarray:
    """[count] float32, 0 for the own one, 1 for the others."""
    return (np.arange(count) != own).astype(np.float32)


INPUTS: dict[str, Callable[[Comparison], Arrays | None]] = {
    "video": _video,
    "mask": _mask,
    **{kind: functools.partial(_masked, kind) for kind in MASKED},
    "outcome": _outcome,
    "variants": _variants,
    "variant_videos": _variant_videos,
    **{kind: functools.partial(_tracks, kind) for kind in ("keypoints", "objects", *ON_SURFACES)},
}
"""Arrays that the functions of metrics take, by `input_kind`; None where the truth has nothing to compare."""


def _curve(comparison: Comparison, name: str, arrays: Arrays) -> np.ndarray:
    """[t] float32, the values by frame of a metric of frames."""
    metric = METRICS[name]
    assert metric.curve is not None, "metrics of frames have one"
    if metric.inputs in ("mask", "outcome"):
        blocks = [cut_blocks(array, metric.whole) for array in arrays]
    else:
        blocks = _video_blocks(comparison, metric.inputs, metric.whole)
    curves = [metric.curve(*parts) for parts in zip(*blocks, strict=True)]
    return np.concatenate(jax.device_get(curves))[: len(arrays[0])].astype(np.float32)


def _video_blocks(comparison: Comparison, kind: str, whole: bool = False) -> list[list[Any]]:
    """The two videos of a comparison, and the true masks of a kind of input, each in blocks."""
    masks = [getattr(comparison.episode, kind)] if kind in MASKED else []
    return [frames.blocks(whole) for frames in (comparison.video, comparison.episode.target, *masks)]


def _curves_of_features(comparison: Comparison, metrics: Collection[str], inputs: Inputs) -> dict[str, np.ndarray]:
    """Curves [t] float32 by metric, of those that LPIPS's network makes: it sees each video once for all of them."""
    by_function = {METRICS[name].curve: name for name in metrics if inputs[input_kind(name)] is not None}
    whole, robot, region = (by_function.get(curve) for curve in (lpips, robot_lpips_frames, region_lpips_frames))
    curves: dict[str, np.ndarray] = {}
    if whole or robot:
        plain, weighted = _feature_distances(comparison, "robot" if robot else "video")
        curves |= {whole: plain} if whole else {}
        curves |= {robot: weighted} if robot and weighted is not None else {}
    arrays = inputs["region"] if region else None
    if region and arrays is not None:
        if whole and _touches_all_borders(arrays[2][0]):  # the box is the whole frame, as it often is
            curves[region] = curves[whole]
        else:
            box = union_box(arrays[2][:1])  # of one frame, as all have these pixels: one program for all lengths
            curves[region], _ = _feature_distances(comparison, "video", box)
    return curves


def _feature_distances(comparison: Comparison, kind: str, box: Box | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    blocks = None if is_on_cpu() else _video_blocks(comparison, kind)
    prediction, target = _video(comparison)
    robot = comparison.episode.robot if kind == "robot" else None
    masks = None if robot is None else robot.frames
    return comparison.episode.features.distances(prediction, target, masks, box, blocks)


def _touches_all_borders(mask: np.ndarray) -> bool:
    """Does the bounding box of a mask [h w] touch all four borders of the image?"""
    return bool(mask[[0, -1]].any(axis=1).all() and mask[:, [0, -1]].any(axis=0).all())


def _grade_tracks(
    comparison: Comparison, metrics: Collection[str], inputs: Inputs
) -> dict[str, tuple[float, np.ndarray | None]]:
    """Scores and curves [t], if any, of all metrics of tracks, computed on the CPU because tracks are small."""
    scores: dict[str, tuple[float, np.ndarray | None]] = {}
    kinds = {name: input_kind(name) for name in metrics if METRICS[name].inputs == "track"}
    for kind in dict.fromkeys(kinds.values()):
        names, arrays = tuple(name for name in kinds if kinds[name] == kind), inputs[kind]
        if arrays is not None:
            options = comparison.track_options(kind)
            padded = [fill_up(fill_up(array, 0, TRACK_BLOCK, 0), 1, POINT_BLOCK, 0) for array in arrays]
            with jax.default_device(jax.local_devices(backend="cpu")[0]):
                values, curves = jax.device_get(_compare_tracks(names, padded, options))
            count = len(arrays[0])
            scores |= {name: (float(values[name]), curves[name][:count] if name in curves else None) for name in names}
    return scores


@functools.partial(jax.jit, static_argnums=0)
def _compare_tracks(
    names: tuple[str, ...], arrays: list[jax.Array], options: dict[str, jax.Array]
) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    """Metrics of tracks by name, as one program: scalars, and [t] of each frame alone, NaN where it has nothing to compare."""
    values = {name: _score(name, arrays, options) for name in names}
    frames = [array[:, None] for array in arrays]
    of_frames = options | {"diagonal": options["diagonal"][:, None], "frames": jnp.int32(1)}
    axes = {name: 0 if name == "diagonal" else None for name in of_frames}
    curves = {
        name: jax.vmap(functools.partial(_score, name), in_axes=(0, axes))(frames, of_frames)
        for name in names
        if not METRICS[name].whole
    }
    return values, curves


def _score(name: str, arrays: list[jax.Array], options: dict[str, jax.Array]) -> jax.Array:
    """The scalar of a metric of tracks, with those of the options that its function takes."""
    metric = METRICS[name]
    return metric.function(*arrays, **{option: options[option] for option in metric.options})


def _mean_of_known(curve: np.ndarray) -> float:
    """Mean of the values of a curve [t] that are not NaN; NaN where there is none."""
    known = curve[~np.isnan(curve)]
    return float(np.mean(known, dtype=np.float64)) if len(known) else math.nan
