"""The scores of one video: a prediction is compared with the episode that it predicts, by estimators and then by metrics.

Frames and points go through the compiler in blocks of one size, so that a few programs serve episodes of all lengths.
"""

import functools
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import cached_property

import jax
import numpy as np

from xew.metrics import METRICS, contact_f1
from xew.metrics.backends import Confirmer, Masker, Tracker
from xew.metrics.estimators.contact import predicted_contact
from xew.metrics.estimators.presence import confirm_tracks
from xew.metrics.metric import ACCELERATOR_CHUNK
from xew.metrics.perceptual import (
    KEPT_FEATURES,
    SMALLEST_SIDE,
    SharedFeatures,
    lpips,
    region_lpips_frames,
    robot_lpips_frames,
    union_box,
)
from xew.metrics.truth import Points, Truth, is_inside

FRAME_BLOCK = 4
"""Number of frames graded at once on a CPU; on a GPU it is `ACCELERATOR_CHUNK`. A video's last block is filled up: a short one
costs little."""
WHOLE_BLOCK = 16
"""Number of frames that a video is filled up to a multiple of on a CPU for metrics that need all of it."""
TRACK_BLOCK, POINT_BLOCK = 64, 32
"""Numbers of frames and points that tracks are filled up to multiples of, so that videos of all lengths and robots share a few
programs: compiling one takes seconds, running it milliseconds."""
OF_WHOLE_FRAMES = {"region_lpips": "lpips"}
"""Metrics of the robot's box by name, each with the metric that it equals where the box is the whole frame, as it often is."""
DIAGNOSTICS = {"contact_f1": contact_f1}
"""Functions by name that are computed where asked for and are no part of the reported suite."""


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
    """The kind of arrays that a metric or a diagnostic compares, a key of `truth.NEEDS`."""
    if name in DIAGNOSTICS:
        return "contact"
    metric = METRICS[name]
    if metric.inputs != "track":
        return metric.inputs
    if metric.points == "surfaces":
        return "object_points" if metric.dimension == "objects" else "robot_points"
    return "objects" if metric.dimension == "objects" else "keypoints"


@dataclass(frozen=True)
class Comparison:
    """A prediction, the truth, and the estimators that find robot and points in the prediction (they see all frames)."""

    prediction: np.ndarray
    """[t h w 3] uint8, of the truth's shape."""
    truth: Truth
    masker: Masker
    tracker: Tracker
    first: int = 1
    """The first graded frame; those before it were given to the model."""
    shown: np.ndarray | None = None
    """[t h w 3] uint8, what the estimators see of the prediction; the prediction itself where left out."""
    _found: dict[str, np.ndarray] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def seen(self) -> np.ndarray:
        """Video [t h w 3] uint8 that the estimators see."""
        return self.prediction if self.shown is None else self.shown

    @cached_property
    def video(self) -> tuple[np.ndarray, np.ndarray]:
        """The graded frames [t h w 3] uint8 of the prediction and of the truth, whose array all predictions share."""
        target = self.truth.notes.setdefault(f"frames from {self.first}", self.truth.rgb[self.first :])
        return self.prediction[self.first :], target

    @property
    def side(self) -> float:
        """Square root of the image's area [pixels]."""
        return math.sqrt(self.prediction.shape[1] * self.prediction.shape[2])

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
        return known

    def find(self, kind: str) -> np.ndarray:
        """Where the tracker finds the points of a kind [t k 2] pixels, NaN where lost or hidden in the truth.

        Raises ValueError where the truth was read without them.
        """
        if kind not in self.points:
            raise ValueError("the truth has no points on surfaces; ask read_truth for 'robot_points' and 'object_points'.")
        if kind not in self._found:
            self._found.update(_find_points(self, kind))
        return self._found[kind]


ON_SURFACES = ("robot_points", "object_points")
"""Kinds of points that are found in one pass, whoever the tracker is."""


def _find_points(c: Comparison, kind: str) -> dict[str, np.ndarray]:
    """Tracks [t k 2] by kind: of the kind that is asked for, and of those that the tracker finds in the same pass.

    A place on a surface that does not have the color of the point's body is none, so that an object is not found by what is
    round it.
    """
    alone = ON_SURFACES if kind in ON_SURFACES else (kind,)
    kinds = tuple(c.points) if getattr(c.tracker, "pointwise", False) else alone
    pixels, visible = (np.concatenate([getattr(c.points[k], name) for k in kinds], axis=1) for name in ("pixels", "visible"))
    seen = visible.any(axis=0)
    found = np.full(pixels.shape, np.nan, np.float32)
    if seen.any():
        found[:, seen] = c.tracker(c.seen, c.truth.rgb, np.nan_to_num(pixels[:, seen]), visible[:, seen])
    if c.truth.surfaces is not None and c.truth.surfaces.shown is not None:
        body = np.concatenate([_bodies(c.points[k]) for k in kinds])
        some = seen & (body >= 0)
        if some.any():
            confirm = c.tracker.confirm if isinstance(c.tracker, Confirmer) else confirm_tracks
            known = c.seen, c.truth.rgb, np.nan_to_num(pixels[:, some]), visible[:, some], c.truth.surfaces.shown, body[some]
            found[:, some] = confirm(found[:, some], *known)
    ends = np.cumsum([c.points[k].visible.shape[1] for k in kinds])
    return dict(zip(kinds, np.split(found, ends[:-1], axis=1), strict=True))


def _bodies(points: Points) -> np.ndarray:
    """[k] int32, the body that each point lies on, -1 where that is not known."""
    return np.full(points.visible.shape[1], -1, np.int32) if points.body is None else points.body


def grade(comparison: Comparison, metrics: Collection[str]) -> Grades:
    """Scores of one predicted video by the metrics and diagnostics of these names."""
    inputs = {kind: INPUTS[kind](comparison) for kind in sorted({input_kind(name) for name in metrics})}
    values: dict[str, float] = {}
    curves: dict[str, np.ndarray] = {}
    blocks = Blocks(comparison)
    shared = _curves_by_shared_features(comparison, metrics, inputs, blocks)
    of_tracks = _grade_tracks(comparison, metrics, inputs)
    for name in metrics:
        arrays = inputs[input_kind(name)]
        if arrays is None:
            values[name] = float("nan")
        elif name in DIAGNOSTICS:
            values[name] = float(DIAGNOSTICS[name](*arrays))
        elif name in of_tracks:
            values[name], curve = of_tracks[name]
            curves |= {} if curve is None else {name: curve}
        else:
            whole = OF_WHOLE_FRAMES.get(name)
            known = curves.get(whole) if whole and _touches_all_borders(arrays[-1][0]) else None
            if known is None:
                known = shared[name] if name in shared else _curve(name, arrays, blocks)
            curves[name] = known
            values[name] = _mean_of_known(curves[name])
    prediction, target = comparison.video
    return Grades(values, curves, int(np.all(prediction == target, axis=(1, 2, 3)).sum()))


Arrays = tuple[np.ndarray, ...]


def _video(c: Comparison) -> Arrays:
    return c.video


def _mask(c: Comparison) -> Arrays:
    return c.masker(c.seen, c.truth.rgb, c.truth.mask)[c.first :], c.truth.mask[c.first :]


def _region(c: Comparison) -> Arrays | None:
    """The two videos and, for each frame, all pixels that show the robot at any time; None where its box is too small."""
    covered = np.any(c.truth.mask[c.first :], axis=0)
    _, _, height, width = union_box(np.expand_dims(covered, 0))
    if min(int(height), int(width)) < SMALLEST_SIDE:
        return None
    return *c.video, np.broadcast_to(covered, c.truth.mask[c.first :].shape)


def _robot(c: Comparison) -> Arrays | None:
    """The two videos and the robot's true masks, frame by frame; None where no frame shows the robot."""
    mask = c.truth.mask[c.first :]
    if not mask.any() or min(mask.shape[1:]) < SMALLEST_SIDE:
        return None
    return *c.video, mask


def _tracks(kind: str, c: Comparison) -> Arrays | None:
    """Tracked points, true points and visibility of those that are ever seen; None where none is, whatever the prediction."""
    found, points = c.find(kind), c.points[kind]
    pixels, visible = np.nan_to_num(points.pixels[c.first :]), points.visible[c.first :]
    seen = visible.any(axis=0)
    return (found[c.first :, seen], pixels[:, seen], visible[:, seen]) if seen.any() else None


def _contact(c: Comparison) -> Arrays | None:
    """Predicted and true contact [t, pairs of a hand and an object that touch at some time]; None where none does.

    What a hand holds is mostly behind it; so the tracker is asked for all that is in the image, also where it is covered.
    """
    arms, objects = np.nonzero(np.any(c.truth.contact, axis=0))
    points = np.concatenate([c.truth.hands, c.truth.objects], axis=1)
    within = is_inside(points, c.truth.rgb.shape)
    if not within[:, 2 + objects].any():
        return None
    true = np.where(within[..., None], points, np.nan)
    found = c.tracker(c.seen, c.truth.rgb, np.nan_to_num(points), within)
    apart, true_apart = (np.linalg.norm(some[:, arms] - some[:, 2 + objects], axis=-1) for some in (found, true))
    contact = c.truth.contact[:, arms, objects]
    return predicted_contact(apart, true_apart, contact)[c.first :], contact[c.first :]


INPUTS: dict[str, Callable[[Comparison], Arrays | None]] = {
    "video": _video,
    "mask": _mask,
    "region": _region,
    "robot": _robot,
    **{kind: functools.partial(_tracks, kind) for kind in ("keypoints", "objects", *ON_SURFACES)},
    "contact": _contact,
}
"""Arrays that the functions of metrics take, by `input_kind`; None where the truth has nothing to compare."""


def _curves_by_shared_features(
    comparison: Comparison, metrics: Collection[str], inputs: dict[str, Arrays | None], blocks: "Blocks"
) -> dict[str, np.ndarray]:
    """Curves [t] float32 by metric, of those that LPIPS's network makes: it sees each video once for all of them."""
    by_function = {METRICS[name].curve: name for name in metrics if name in METRICS and inputs[input_kind(name)] is not None}
    device = "cpu" if jax.default_backend() == "cpu" else "gpu"
    features = comparison.truth.notes.setdefault(
        f"features from frame {comparison.first}", SharedFeatures(KEPT_FEATURES[device])
    )
    curves: dict[str, np.ndarray] = {}
    whole, robot, region = (by_function.get(curve) for curve in (lpips, robot_lpips_frames, region_lpips_frames))
    video, cut = comparison.video, None if device == "cpu" else functools.partial(blocks.cut, whole=False)
    if whole or robot:
        mask = comparison.truth.mask[comparison.first :] if robot else None
        plain, weighted = features.distances(*video, mask, cut=cut)
        curves |= {whole: plain} if whole else {}
        curves |= {robot: weighted} if robot and weighted is not None else {}
    arrays = inputs["region"] if region else None
    if region and arrays is not None and not (OF_WHOLE_FRAMES.get(region) in curves and _touches_all_borders(arrays[-1][0])):
        curves[region] = features.distances(*video, box=union_box(arrays[-1]), cut=cut)[0]
    return curves


def _touches_all_borders(mask: np.ndarray) -> bool:
    """Does the bounding box of a mask [h w] touch all four borders of the image?"""
    return bool(mask[[0, -1]].any(axis=1).all() and mask[:, [0, -1]].any(axis=0).all())


def _grade_tracks(
    comparison: Comparison, metrics: Collection[str], inputs: dict[str, Arrays | None]
) -> dict[str, tuple[float, np.ndarray | None]]:
    """Scores and curves [t], if any, of all metrics of tracks. What is filled up is not valid, which none of them looks at.

    Tracks are small, so that a GPU has nothing to gain: they are compared where they are.
    """
    found: dict[str, tuple[float, np.ndarray | None]] = {}
    kinds = {name: input_kind(name) for name in metrics if name in METRICS and METRICS[name].inputs == "track"}
    for kind in dict.fromkeys(kinds.values()):
        names, arrays = tuple(name for name in kinds if kinds[name] == kind), inputs[kind]
        if arrays is not None:
            padded = [_fill(_fill(array, 0, TRACK_BLOCK, 0), 1, POINT_BLOCK, 0) for array in arrays]
            with jax.default_device(jax.local_devices(backend="cpu")[0]):
                values, curves = jax.device_get(_compare_tracks(names, padded, np.float32(comparison.side)))
            count = len(arrays[0])
            found |= {name: (float(values[name]), curves[name][:count] if name in curves else None) for name in names}
    return found


@functools.partial(jax.jit, static_argnums=0)
def _compare_tracks(
    names: tuple[str, ...], arrays: list[jax.Array], side: jax.Array
) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    """Metrics of tracks by name, as one program: scalars, and [t] of each frame alone, NaN where it has nothing to compare."""
    chosen = {name: METRICS[name] for name in names}
    functions = {name: functools.partial(m.function, side=side) if m.by_image else m.function for name, m in chosen.items()}
    values = {name: function(*arrays) for name, function in functions.items()}
    frames = [array[:, None] for array in arrays]
    return values, {name: jax.vmap(functions[name])(*frames) for name, m in chosen.items() if not m.whole}


Block = tuple[np.ndarray, list[jax.Array]]
"""An array, which is kept so that no other has its identity, and its blocks on a device."""


class Blocks:
    """Arrays of a comparison as metrics of frames take them: in blocks of one size, the last filled up with its last frame.

    On a GPU a video is put there once for all its metrics, and the truth's once for all its predictions.
    """

    def __init__(self, comparison: Comparison) -> None:
        self._target = comparison.video[1]
        self._of_truth: dict[tuple[int, bool], Block] = comparison.truth.notes.setdefault("blocks", {})
        self._of_prediction: dict[tuple[int, bool], Block] = {}

    def cut(self, array: np.ndarray, whole: bool) -> list[np.ndarray] | list[jax.Array]:
        """Blocks [n ...] of an array [t ...]; a single one where it is asked for whole."""
        if jax.default_backend() == "cpu":
            return _cut(array, WHOLE_BLOCK if whole else FRAME_BLOCK, whole)
        kept = self._of_truth if array is self._target else self._of_prediction
        if (id(array), whole) not in kept:
            kept[id(array), whole] = array, [jax.device_put(part) for part in _cut(array, ACCELERATOR_CHUNK, whole)]
        return kept[id(array), whole][1]


def _cut(array: np.ndarray, block: int, whole: bool) -> list[np.ndarray]:
    if whole:
        return [_fill(array, 0, block, "last")]
    parts = [array[first : first + block] for first in range(0, len(array), block)]
    return [*parts[:-1], _fill(parts[-1], 0, block, "last")]


def _curve(name: str, arrays: Arrays, blocks: Blocks) -> np.ndarray:
    """[t] float32."""
    curve = METRICS[name].curve
    assert curve is not None, "metrics of frames have one"
    count = len(arrays[0])
    parts = zip(*(blocks.cut(array, METRICS[name].whole) for array in arrays), strict=True)
    curves = [curve(*part) for part in parts]
    return np.concatenate(jax.device_get(curves))[:count].astype(np.float32)


def _mean_of_known(curve: np.ndarray) -> float:
    """Mean of the values of a curve [t] that are not NaN; NaN where there is none."""
    known = curve[~np.isnan(curve)]
    return float(np.mean(known, dtype=np.float64)) if len(known) else math.nan


def _fill(array: np.ndarray, axis: int, block: int, value: str | int) -> np.ndarray:
    """Up to a multiple of `block` along an axis, with a value or with what is last."""
    missing = -array.shape[axis] % block
    widths = [(0, missing if i == axis else 0) for i in range(array.ndim)]
    return np.pad(array, widths, mode="edge") if value == "last" else np.pad(array, widths, constant_values=value)
