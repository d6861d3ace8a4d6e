"""What a metric is, and what all metrics share: checks on arrays, and frames by the chunk.

A metric compares one of INPUTS, which grade.py makes of a prediction and of the ground truth (truth.py). To add a metric of
those, only its function and its entry in METRICS are written.
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
from jaxtyping import Bool, Float, Float32, UInt8

from xew.metrics.mergeable.sums import Mergeable

AnyArray: TypeAlias = jax.Array | np.ndarray
Video: TypeAlias = UInt8[AnyArray, "t h w 3"] | Float[AnyArray, "t h w 3"]
"""RGB, uint8 or floating in [0, 1]."""
Masks: TypeAlias = Bool[AnyArray, "t h w"]
Tracks: TypeAlias = Float[AnyArray, "t k 2"]
"""Points in pixels, x right, y down; NaN where a prediction lost one."""
Valid: TypeAlias = Bool[AnyArray, "t k"]
"""Flags of the points that can be seen in the target."""
Contacts: TypeAlias = Bool[AnyArray, "t c"]
"""Flags of the pairs of bodies that touch."""
ByFrame: TypeAlias = Float32[jax.Array, " t"]
"""One value for each frame."""
Scalar: TypeAlias = Float32[jax.Array, ""]

P = ParamSpec("P")
R = TypeVar("R")

INPUTS = ("video", "mask", "region", "robot", "track")
"""Kinds of what a metric compares. video: two [t h w 3]. mask: two [t h w]. region: two videos and the union over time of the
target's masks. robot: two videos and the target's masks frame by frame. track: two [t k 2], valid [t k]."""
ESTIMATED_INPUTS = ("mask", "track")
"""Inputs that have to be estimated in a prediction."""
SUITES = {
    "paper": "the paper's definitions, so that its tables can be set beside ours",
    "strict": "what is lost is an error, points lie on surfaces, and one tolerance holds for all robots",
}
"""Suites of metrics by name, each with what it promises."""
POINTS = ("origins", "surfaces")
"""Kinds of points that tracks follow: origins of links and objects, or points on surfaces of links and of what moves."""

ACCELERATOR_CHUNK = 64
"""Number of frames computed at once on a GPU or TPU; one is fastest on a CPU, where a frame's intermediates then stay in its
cache."""


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
    """Unit of the number, '' where it has none."""
    range: tuple[int | float, int | float]
    """Least and largest value."""
    higher_is_better: bool
    """Direction of the metric."""
    inputs: str
    """Kind of what the functions compare, one of `INPUTS`."""
    reference: str
    """Source of the definition, as the report prints it."""
    title: str = ""
    """Short title in tables and charts; the registry's key where left out."""
    reported: bool = True
    """Whether a study's full tables show it; False for companions of other metrics."""
    whole: bool = False
    """Whether its values by frame need the whole video, so that frames are never graded in blocks (PSNR, by its cap); of a
    metric of tracks, whether a frame has no value of its own (nDTW)."""
    parts: Callable[..., tuple[jax.Array, jax.Array]] | None = None
    """Function of the same inputs to the values that the metric is the mean of, and which of them count."""
    suites: tuple[str, ...] = tuple(SUITES)
    """Suites that it belongs to, keys of `SUITES`."""
    points: str = "origins"
    """Points that a metric of tracks compares, one of `POINTS`."""
    by_image: bool = False
    """Whether its functions take the option `side`, the square root of the image's area [pixels]."""
    state: Mergeable | None = None
    """Mergeable states; left out, they are the mean of `parts`, or else of the values by frame."""

    @property
    def estimated(self) -> bool:
        """Does it need an estimator, so that even the true video does not get the best score?"""
        return self.inputs in ESTIMATED_INPUTS


def check_first(check: Callable[..., None], **options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a metric with a check of its arguments, whose one-line message is what a user sees of a wrong array.

    It stands above the function and so runs before anything that checks the function's annotations, as tests do.

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
    if np.shape(prediction) != np.shape(target):
        raise ValueError(
            f"prediction is {np.shape(prediction)}, target is {np.shape(target)}; they must have one shape [t h w 3]."
        )
    if np.ndim(target) != 4 or np.shape(target)[-1] != 3:
        raise ValueError(f"videos are {np.shape(target)}, expected [t h w 3]; add the time axis, drop alpha.")
    if not np.shape(target)[0]:
        raise ValueError("the videos have no frames.")
    if min(np.shape(target)[1:3]) < smallest_side:
        raise ValueError(f"frames are {np.shape(target)[1:3]}, this metric needs sides of at least {smallest_side} pixels.")
    kinds = {jnp.result_type(video) for video in (prediction, target)}
    if len(kinds) != 1 or not all(kind == jnp.uint8 or jnp.issubdtype(kind, jnp.floating) for kind in kinds):
        found = sorted(str(kind) for kind in kinds)
        raise TypeError(f"videos have dtype {' and '.join(found)}, expected both uint8, or both floating in [0, 1].")


def check_masks(prediction: Any, target: Any) -> None:
    """Raise ValueError or TypeError unless both are bool [t h w] of one shape."""
    if np.shape(prediction) != np.shape(target) or np.ndim(target) != 3:
        raise ValueError(f"masks are {np.shape(prediction)} and {np.shape(target)}, expected one shape [t h w].")
    for name, mask in (("prediction", prediction), ("target", target)):
        check_bool(name, mask)


def check_bool(name: str, array: Any) -> None:
    """Raise TypeError unless an array [...] is bool."""
    if jnp.result_type(array) != jnp.bool_:
        raise TypeError(f"{name} has dtype {jnp.result_type(array)}, expected bool; compare with a threshold first.")


def check_tracks(prediction: Any, target: Any, valid: Any) -> None:
    """Raise ValueError or TypeError unless tracks are floating [t k 2] of one shape and valid is bool [t k]."""
    if np.shape(prediction) != np.shape(target) or np.ndim(target) != 3 or np.shape(target)[-1] != 2:
        raise ValueError(f"tracks are {np.shape(prediction)} and {np.shape(target)}, expected one shape [t k 2].")
    if np.shape(valid) != np.shape(target)[:2]:
        raise ValueError(f"valid is {np.shape(valid)}, expected {np.shape(target)[:2]}, a flag for each point and frame.")
    check_bool("valid", valid)


def check_contacts(prediction: Any, target: Any) -> None:
    """Raise ValueError or TypeError unless both are bool [t c] of one shape."""
    if np.shape(prediction) != np.shape(target) or np.ndim(target) != 2:
        raise ValueError(f"contacts are {np.shape(prediction)} and {np.shape(target)}, expected one shape [t c].")
    for name, contact in (("prediction", prediction), ("target", target)):
        check_bool(name, contact)


def map_frames(function: Callable[..., Any], frames: Any, chunk: int | None) -> Any:
    """`map_chunks` for a function of one frame, the leaves of `frames` without their time axis."""
    return map_chunks(jax.vmap(function), frames, chunk)


def map_chunks(function: Callable[..., Any], frames: Any, chunk: int | None) -> Any:
    """`function` of a chunk of frames at a time, so that memory does not grow with the video.

    Chunks are of one size, so that there is one program to compile; the last is filled up with copies of the last frame.

    Args:
        function: of some frames: the leaves of `frames` with a shorter time axis. A frame's result is its own.
        frames: arrays [t ...] in any tree.
        chunk: most frames computed at once; None for 1 on a CPU and `ACCELERATOR_CHUNK` elsewhere.

    Returns:
        What the function returns, with a time axis [t ...].

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
