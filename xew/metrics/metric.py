"""The type of a metric, and shared checks of arrays and chunks of frames.

A metric compares one of INPUTS, which grade.py prepares from a prediction and the ground truth (truth.py). To add a metric of
these inputs, write its function and its entry in METRICS (xew/metrics/__init__.py).
"""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Float32, Int32, UInt8

AnyArray: TypeAlias = jax.Array | np.ndarray
Video: TypeAlias = UInt8[AnyArray, "t h w 3"] | Float[AnyArray, "t h w 3"]
"""RGB, uint8 or floating in [0, 1]."""
Masks: TypeAlias = Bool[AnyArray, "t h w"]
Tracks: TypeAlias = Float[AnyArray, "t k 2"]
"""Points in pixels, x right, y down; NaN where a prediction lost one. A target's must be known where `valid`: if one is not,
the score is NaN."""
Valid: TypeAlias = Bool[AnyArray, "t k"]
"""Flags of the points that can be seen in the target."""
ByFrame: TypeAlias = Float32[jax.Array, " t"]
"""One value for each frame."""
Scalar: TypeAlias = Float32[jax.Array, ""]

P = ParamSpec("P")
R = TypeVar("R")

INPUTS = ("video", "mask", "region", "robot", "bodies", "track", "outcome", "variants", "variant_videos")
"""Kinds of what a metric compares. video: two [t h w 3]. mask: two [t h w]. region: two videos and the union over time of the
target's masks. robot: two videos and the target's masks frame by frame. bodies: the same with masks of the robot and all
objects. track: two [t k 2], valid [t k]. outcome: two [t], the task's progress. variants: two [k], distances
from what happens under k variants of the commands. variant_videos: the same, from the true videos of the variants."""
ESTIMATED_INPUTS = ("mask", "track", "outcome", "variants")
"""Inputs that have to be estimated in a prediction."""
SUITES = {
    "paper": "the paper's definitions, so its tables compare with ours",
    "strict": "what is lost is an error, points lie on surfaces, and one tolerance holds for all robots",
}
"""Suites of metrics by name, each with what it promises."""
POINTS = ("origins", "surfaces")
"""Kinds of points that tracks follow: origins of links and objects, or points on surfaces of links and of what moves."""

OPTIONS = {
    "side": "square root of the image's area [pixels]",
    "largest": "the image's diagonal [pixels]",
    "diagonal": "[t] diagonal [pixels] of the box of all link origins inside the image, occluded or not",
    "frames": "number of frames",
    "body": "[k] number of the body that each point lies on, -1 where that is not known",
    "finger": "[k] number of the finger that each point lies on, 0 and 1 of the left hand, 2 and 3 of the right, else -1",
}
"""Options of metrics of tracks that grading supplies, with what each holds."""

OVERSHOOT = 0.25
"""Amount by which floats may lie outside of [0, 1]: more than a decoder's overshoot, less than what [-1, 1] shows."""
ACCELERATOR_CHUNK = 64
"""Number of frames computed at once on a GPU or TPU; one is fastest on a CPU, where a frame's intermediates then stay in its
cache."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Total:
    """Sum and number of values. The sum of two totals is the total of the values of both."""

    total: Float32[jax.Array, ""]
    """Sum of the values that count; not finite where one of them is not."""
    count: Int32[jax.Array, ""]

    @property
    def mean(self) -> Float32[jax.Array, ""]:
        """Mean [()] of the values that count; NaN where there is none."""
        return self.total / self.count.astype(jnp.float32)

    def __add__(self, other: "Total") -> "Total":
        return Total(self.total + other.total, self.count + other.count)


def total_of(values: Float32[jax.Array, "..."], counts: Bool[jax.Array, "..."] | None = None) -> Total:
    """Total of values [...] float32: of those where `counts` [...] bool, or of all."""
    counts = jnp.ones(values.shape, bool) if counts is None else counts
    return Total(jnp.sum(jnp.where(counts, values, 0), dtype=jnp.float32), jnp.sum(counts, dtype=jnp.int32))


@dataclass(frozen=True)
class Metric:
    """One entry of the registry `METRICS`: all that grading, a table or a figure needs to know of a metric."""

    function: Callable[..., jax.Array]
    """Metric as users call it: pure and jitted."""
    curve: Callable[..., jax.Array] | None
    """Function of the same inputs before the mean over frames, [t]; None for metrics of tracks, whose frames are graded by
    `function`."""
    dimension: str
    """Group of metrics, a key of `xew.protocol.DIMENSION_TITLES` or one of your own: reported side by side, never collapsed."""
    unit: str
    range: tuple[int | float, int | float]
    """Least and largest value."""
    higher_is_better: bool
    inputs: str
    """Kind of what the functions compare, one of `INPUTS`."""
    reference: str
    """Source of the definition, as the report prints it."""
    title: str = ""
    """Short title in tables and charts; the registry's key where left out."""
    reported: bool = True
    """Whether a study's full tables show it; False for companions of other metrics."""
    whole: bool = False
    """Whether its values by frame need the whole video, so frames are never graded in blocks (flicker); of a metric of tracks,
    whether a frame has no value of its own (nDTW)."""
    parts: Callable[..., tuple[jax.Array, jax.Array]] | None = None
    """Function of the same inputs to the values that the metric is the mean of, and which of them count; None where these are
    the values by frame, or where it is a mean of means (`trajectory_error`)."""
    suites: tuple[str, ...] = tuple(SUITES)
    counterpart: str = ""
    """Name of the metric of the suite paper in whose place it stands in the suite strict, and decides."""
    points: str = "origins"
    """Points that a metric of tracks compares, one of `POINTS`."""
    options: tuple[str, ...] = ()
    """Names of options of its functions that grading supplies to a metric of tracks, keys of `OPTIONS`."""

    @property
    def estimated(self) -> bool:
        """Does it need an estimator, so even the true video does not get the best score?"""
        return self.inputs in ESTIMATED_INPUTS

    @property
    def best(self) -> float:
        """The best score."""
        return self.range[self.higher_is_better]

    @property
    def leaves_tasks(self) -> bool:
        """Do tasks without power leave its mean (`xew.statistics.find_power`)?"""
        return self.estimated and "strict" in self.suites and self.dimension != "outcome"

    def total(self, *inputs: AnyArray, **options: Any) -> Total:
        """Sum and number of the values that the metric averages; totals of parts of a video, or of several videos, add up.

        Args:
            inputs, options: of `function`, for all frames or some. Paths cannot be cut (nDTW).

        Raises:
            ValueError: the metric is no mean over frames or points.
        """
        if self.parts is not None:
            return total_of(*self.parts(*inputs, **options))
        if self.curve is None:
            raise ValueError(f"{self.title or self.function} is a mean of means; call it with all frames of a video.")
        return total_of(self.curve(*inputs, **options))


def check_first(check: Callable[..., None], **options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a metric with a check of its arguments, so users see a one-line message for a wrong array.

    It stands above jax.jit, and before anything that checks annotations.

    Args:
        check: takes some of the function's parameters, by the same names.
        options: further arguments of the check.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        names = [name for name in inspect.signature(check).parameters if name in signature.parameters]

        @functools.wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            given = signature.bind(*args, **kwargs).arguments
            check(**{name: given[name] for name in names if name in given}, **options)
            return function(*args, **kwargs)

        return checked

    return decorate


def check_videos(prediction: Any, target: Any, smallest_side: int = 1) -> None:
    """Raise ValueError or TypeError unless both are [t h w 3], of one shape, uint8 or floating in [0, 1].

    Args:
        prediction, target: the two videos.
        smallest_side: least side of a frame [pixels] for which the metric is defined.
    """
    check_arrays(prediction=prediction, target=target)
    if np.shape(prediction) != np.shape(target):
        raise ValueError(
            f"prediction is {np.shape(prediction)}, target is {np.shape(target)}; they must have one shape [t h w 3]."
        )
    if np.ndim(target) != 4 or np.shape(target)[-1] != 3:
        raise ValueError(f"videos are {np.shape(target)}, expected [t h w 3]; {_remedy_of_shape(np.shape(target))}.")
    if not np.shape(target)[0]:
        raise ValueError("the videos have no frames.")
    if min(np.shape(target)[1:3]) < smallest_side:
        raise ValueError(f"frames are {np.shape(target)[1:3]}, this metric needs sides of at least {smallest_side} pixels.")
    kinds = {jnp.result_type(video) for video in (prediction, target)}
    if len(kinds) != 1 or not all(kind == jnp.uint8 or jnp.issubdtype(kind, jnp.floating) for kind in kinds):
        dtypes = sorted(str(kind) for kind in kinds)
        raise TypeError(f"videos have dtype {' and '.join(dtypes)}, expected both uint8, or both floating in [0, 1].")
    for name, video in (("prediction", prediction), ("target", target)):
        _check_range(name, video)


def check_masked_videos(prediction: Any, target: Any, target_mask: Any, smallest_side: int = 1) -> None:
    """Raise ValueError or TypeError unless videos are as in `check_videos` and masks bool [t h w] with them."""
    check_videos(prediction, target, smallest_side)
    check_arrays(target_mask=target_mask)
    if np.shape(target_mask) != np.shape(target)[:3]:
        raise ValueError(f"target_mask is {np.shape(target_mask)}, expected {np.shape(target)[:3]}, as the video's [t h w].")
    check_bool("target_mask", target_mask)


def _remedy_of_shape(shape: tuple[int, ...]) -> str:
    """What to do with a video of a wrong shape, in a few words."""
    if len(shape) > 4:
        return "of a batch take one video after another, or use jax.vmap"
    if len(shape) == 4 and 3 in (shape[0], shape[1]):
        return "move the channels last: np.moveaxis(video, 1, -1) of [t 3 h w], (video, 0, -1) of [3 t h w]"
    return "add the time axis, drop alpha"


def _check_range(name: str, video: Any) -> None:
    """Raise ValueError if frames of a floating video [t h w 3] are clearly not in [0, 1].

    Only the first, middle and last one, because a whole video would take longer than its PSNR. OVERSHOOT is admitted.
    """
    if isinstance(video, jax.core.Tracer) or jnp.result_type(video) == jnp.uint8:
        return
    if isinstance(video, jax.Array) and not video.is_fully_addressable:
        return
    places = {"first": 0, "middle": len(video) // 2, "last": len(video) - 1}
    for place, frame in zip(places, np.asarray(video[np.array([*places.values()])], np.float32), strict=True):
        low, high = float(np.fmin.reduce(frame, axis=None)), float(np.fmax.reduce(frame, axis=None))  # which skip NaN
        if low < -OVERSHOOT or high > 1 + OVERSHOOT:
            remedy = "divide by 255" if high > 2 else f"of [-1, 1] take ({name} + 1) / 2"
            raise ValueError(
                f"the {place} frame of {name} goes from {low:.3g} to {high:.3g}, expected floats in [0, 1]; {remedy}."
            )


def check_arrays(**arrays: Any) -> None:
    """Raise TypeError unless all are arrays [...] of NumPy or JAX; the message says how to make one of what was found."""
    for name, array in arrays.items():
        if isinstance(array, np.ndarray | jax.Array) or hasattr(array, "__jax_array__"):
            continue
        kind = type(array)
        remedy = f"{name}.numpy(force=True)" if kind.__module__.split(".")[0] == "torch" else f"np.asarray({name})"
        raise TypeError(f"{name} is a {kind.__module__}.{kind.__qualname__}, expected an array of NumPy or JAX; pass {remedy}.")


def check_masks(prediction: Any, target: Any) -> None:
    """Raise ValueError or TypeError unless both are bool [t h w] of one shape."""
    check_arrays(prediction=prediction, target=target)
    _check_shapes("masks", prediction, target, "[t h w]", np.ndim(target) == 3)
    for name, mask in (("prediction", prediction), ("target", target)):
        check_bool(name, mask)


def _check_shapes(what: str, prediction: Any, target: Any, expected: str, fits: bool) -> None:
    """Raise ValueError unless both arrays are of one shape, which fits what is expected, such as '[t h w]'."""
    if np.shape(prediction) == np.shape(target) and fits:
        return
    batch = "; of a batch use jax.vmap" if np.ndim(target) > len(expected.split()) else ""
    raise ValueError(f"{what} are {np.shape(prediction)} and {np.shape(target)}, expected one shape {expected}{batch}.")


def check_bool(name: str, array: Any) -> None:
    """Raise TypeError unless an array [...] is bool."""
    if jnp.result_type(array) != jnp.bool_:
        raise TypeError(f"{name} has dtype {jnp.result_type(array)}, expected bool; compare with a threshold first.")


def check_tracks(prediction: Any, target: Any, valid: Any) -> None:
    """Raise ValueError or TypeError unless tracks are floating [t k 2] of one shape and valid is bool [t k]."""
    check_arrays(prediction=prediction, target=target, valid=valid)
    _check_shapes("tracks", prediction, target, "[t k 2]", np.ndim(target) == 3 and np.shape(target)[-1] == 2)
    if np.shape(valid) != np.shape(target)[:2]:
        raise ValueError(f"valid is {np.shape(valid)}, expected {np.shape(target)[:2]}, a flag for each point and frame.")
    for name, points in (("prediction", prediction), ("target", target)):
        if not jnp.issubdtype(jnp.result_type(points), jnp.floating):
            raise TypeError(f"{name} has dtype {jnp.result_type(points)}, expected floating pixels; use .astype(np.float32).")
    check_bool("valid", valid)


def map_frames(function: Callable[..., Any], frames: Any, chunk: int | None) -> Any:
    """`map_chunks` for a function of one frame, the leaves of `frames` without their time axis."""
    return map_chunks(jax.vmap(function), frames, chunk)


def map_chunks(function: Callable[..., Any], frames: Any, chunk: int | None) -> Any:
    """Apply a function to chunks of frames, so memory does not grow with the video.

    Chunks have one size and need one program; the last is filled up with copies of the last frame.

    Args:
        function: of frames, whose results are independent of each other.
        frames: arrays [t ...] in any tree.
        chunk: most frames at once; None for 1 on a CPU and `ACCELERATOR_CHUNK` elsewhere.

    Returns:
        The function's results, with a time axis [t ...].

    Raises:
        ValueError: the chunk is under 1.
    """
    chunk = (1 if jax.default_backend() == "cpu" else ACCELERATOR_CHUNK) if chunk is None else chunk
    if chunk < 1:
        raise ValueError(f"chunk is {chunk}, expected at least 1 frame.")
    count = len(jax.tree.leaves(frames)[0])
    chunks = -(-count // chunk)
    size = -(-count // chunks)
    order = np.minimum(np.arange(chunks * size), count - 1).reshape(chunks, size)

    def of_chunk(rows: jax.Array) -> Any:
        return function(jax.tree.map(lambda leaf: jnp.take(leaf, rows, axis=0, mode="clip"), frames))

    values = lax.map(of_chunk, order)
    return jax.tree.map(lambda leaf: leaf.reshape(chunks * size, *leaf.shape[2:])[:count], values)


def fill_up(array: np.ndarray, axis: int, multiple: int, value: float | None = None) -> np.ndarray:
    """An array [...] longer along an axis, up to a multiple, by a value or, left out, by what is last."""
    missing = -array.shape[axis] % multiple
    widths = [(0, missing if i == axis else 0) for i in range(array.ndim)]
    return np.pad(array, widths, mode="edge") if value is None else np.pad(array, widths, constant_values=value)
