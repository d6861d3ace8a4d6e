"""What clients do with metrics: JAX's transformations, types and strictness, arrays that are broken, and arrays of other tools.

All of it over the registry, so that a new metric is held to it too. The matrix traces and compiles nothing.
"""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from xew.metrics import METRICS, boundary_f1, mask_iou, pck, psnr, region_lpips, ssim
from xew.metrics.grade import JUDGED

rng = np.random.default_rng(8)
T, SIDE, K = 2, 31, 3
Arrays = tuple[np.ndarray, ...]


ALONE = {metric.function: name for name, metric in reversed(METRICS.items())}.values()
"""Names of metrics, one of each function: coverage is of four kinds of points."""


def inputs(kind: str, dtype: type = np.float32) -> Arrays:
    """The smallest arrays that every metric of a kind takes."""
    masks = np.ones((2, T, SIDE, SIDE), bool)
    masks[0, :, :9] = False
    if kind == "mask":
        return tuple(masks)
    if kind in JUDGED:
        return tuple(rng.random((2, T)).astype(dtype))
    if kind == "track":
        target = rng.uniform(0, SIDE, (T, K, 2)).astype(dtype)
        return (target + rng.uniform(0, 3, target.shape)).astype(dtype), target, np.ones((T, K), bool)
    videos = tuple(rng.random((2, T, SIDE, SIDE, 3)).astype(dtype))
    videos[1][:, 0] = videos[1][:1, 0]  # stands still
    return videos if kind == "video" else (*videos, masks[1])


def traced_jit(function: Callable, arrays: Arrays) -> object:
    return jax.eval_shape(jax.jit(function), *arrays)


def traced_vmap(function: Callable, arrays: Arrays) -> object:
    return jax.eval_shape(jax.vmap(function), *(np.stack([array, array]) for array in arrays))


def traced_grad(function: Callable, arrays: Arrays) -> object:
    return jax.eval_shape(jax.grad(lambda *given: jnp.mean(function(*given))), *arrays)


def traced_scan(function: Callable, arrays: Arrays) -> object:
    step = lambda total, given: (total + jnp.mean(function(*given)), None)  # noqa: E731
    return jax.eval_shape(lambda *all_given: jax.lax.scan(step, jnp.float32(0), all_given)[0], *(a[None] for a in arrays))


def traced_pmap(function: Callable, arrays: Arrays) -> object:
    return jax.eval_shape(jax.pmap(function), *(array[None] for array in arrays))


def traced_shard_map(function: Callable, arrays: Arrays) -> object:
    mesh = jax.make_mesh((1,), ("videos",), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.devices()[:1])
    each = lambda *given: function(*(array[0] for array in given))[None]  # noqa: E731
    spec = PartitionSpec("videos")
    return jax.eval_shape(jax.shard_map(each, mesh=mesh, in_specs=spec, out_specs=spec), *(array[None] for array in arrays))


def traced_bfloat16(function: Callable, arrays: Arrays) -> object:
    return jax.eval_shape(function, *(jnp.asarray(a, jnp.bfloat16) if a.dtype == np.float32 else a for a in arrays))


def traced_x64(function: Callable, arrays: Arrays) -> object:
    with jax.enable_x64(True):
        return jax.eval_shape(function, *(a.astype(np.float64) if a.dtype == np.float32 else a for a in arrays))


def traced_strict_types(function: Callable, arrays: Arrays) -> object:
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("allow"):
        return jax.eval_shape(function, *arrays)


def traced_strict_ranks(function: Callable, arrays: Arrays) -> object:
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("raise"):
        return jax.eval_shape(function, *arrays)


MODES = (
    traced_jit,
    traced_vmap,
    traced_grad,
    traced_scan,
    traced_pmap,
    traced_shard_map,
    traced_bfloat16,
    traced_x64,
    traced_strict_types,
    traced_strict_ranks,
)
MEANINGLESS = {("mask", traced_grad): "masks are bool", ("mask", traced_bfloat16): "masks are bool"}
"""Kinds of inputs and modes that do not go together, each with the reason."""


def cells() -> Iterator[object]:
    for mode in MODES:
        for name in ALONE:
            if (METRICS[name].inputs, mode) not in MEANINGLESS:
                yield pytest.param(name, mode, id=f"{name}-{mode.__name__.removeprefix('traced_')}")


@pytest.mark.filterwarnings("ignore:jax.pmap:DeprecationWarning")
@pytest.mark.parametrize(("name", "mode"), list(cells()))
def test_every_metric_goes_through_every_transformation(name: str, mode: Callable) -> None:
    found = jax.tree.leaves(mode(METRICS[name].function, inputs(METRICS[name].inputs)))
    assert found and {leaf.dtype for leaf in found} == {jnp.dtype(jnp.float32)}


@pytest.mark.parametrize("mode", [traced_shard_map, traced_x64])
@pytest.mark.parametrize("name", [name for name in ALONE if name != "trajectory_error"])
def test_totals_too(name: str, mode: Callable) -> None:
    def by_total(*arrays: jax.Array) -> jax.Array:
        return METRICS[name].total(*arrays).mean

    assert jax.tree.leaves(mode(by_total, inputs(METRICS[name].inputs)))[0].dtype == jnp.float32


@pytest.mark.parametrize("name", [name for name in ALONE if METRICS[name].inputs == "track" or name in ("psnr", "ssim")])
def test_bfloat16_is_computed_with_in_float32(name: str) -> None:
    short = [jnp.asarray(a, jnp.bfloat16) if a.dtype == np.float32 else a for a in inputs(METRICS[name].inputs)]
    exact = [a.astype(jnp.float32) if a.dtype == jnp.bfloat16 else a for a in short]
    np.testing.assert_allclose(METRICS[name].function(*short), METRICS[name].function(*exact), rtol=1e-6)


@pytest.mark.parametrize("name", [name for name in ALONE if METRICS[name].inputs != "mask"])
def test_nan_goes_through(name: str) -> None:
    """One channel of the last pixel, which no window of LPIPS reaches; of tracks, a true point that ought to be visible."""
    metric, kind = METRICS[name], METRICS[name].inputs
    arrays = inputs(kind)
    place = {"track": (1, 1, 0), **dict.fromkeys(JUDGED, (1,))}.get(kind, (1, -1, -1, 2))
    arrays[1 if kind == "track" else 0][place] = np.nan
    assert np.isnan(np.mean(metric.function(*arrays)))
    assert name == "trajectory_error" or np.isnan(metric.total(*arrays).mean)
    if metric.curve is not None:
        broken = np.array([metric.whole, True])  # the first frame of a metric of changes has no value
        np.testing.assert_array_equal(np.isnan(metric.curve(*arrays)), broken)
        prediction, target, *rest = arrays
        np.testing.assert_array_equal(np.isnan(metric.curve(target, prediction, *rest)), broken)


@pytest.mark.parametrize("name", [name for name in ALONE if METRICS[name].inputs == "mask"])
def test_masks_cannot_be_nan(name: str) -> None:
    with pytest.raises(TypeError, match="expected bool; compare with a threshold"):
        METRICS[name].function(np.full((T, SIDE, SIDE), np.nan), np.ones((T, SIDE, SIDE), bool))


@pytest.mark.parametrize("name", [name for name in ALONE if METRICS[name].inputs == "track"])
def test_no_points_and_no_frames_are_nan(name: str) -> None:
    for shape in ((T, 0), (0, K), (0, 0)):
        points = np.zeros((*shape, 2), np.float32)
        assert np.isnan(METRICS[name].function(points, points, np.zeros(shape, bool)))


class Tensor:
    """What a PyTorch tensor is to a check: an object of that module that is no array of NumPy or JAX."""

    __module__ = "torch"
    shape, ndim, dtype = (T, SIDE, SIDE, 3), 4, np.dtype(np.uint8)


@pytest.mark.parametrize("name", ALONE)
def test_lists_and_tensors_are_one_clear_message(name: str) -> None:
    prediction, target, *rest = inputs(METRICS[name].inputs)
    with pytest.raises(TypeError, match=r"prediction is a builtins.list, expected an array .* np.asarray\(prediction\)"):
        METRICS[name].function(prediction.tolist(), target, *rest)
    with pytest.raises(TypeError, match=r"target is a torch.Tensor, .* target.numpy\(force=True\)"):
        METRICS[name].function(prediction, Tensor(), *rest)


@pytest.mark.parametrize(
    ("metric", "shape", "remedy"),
    [
        (psnr, (2, T, SIDE, SIDE, 3), "jax.vmap"),
        (ssim, (T, 3, SIDE, SIDE), "move the channels last"),
        (ssim, (3, T, SIDE, SIDE), "move the channels last"),
        (psnr, (T, SIDE, SIDE, 4), "drop alpha"),
        (mask_iou, (2, T, SIDE, SIDE), "jax.vmap"),
        (boundary_f1, (2, T, SIDE, SIDE), "jax.vmap"),
        (lambda a, b: pck(a, b, np.ones(a.shape[:-1], bool)), (2, T, K, 2), "jax.vmap"),
    ],
)
def test_shapes_of_other_tools_get_a_remedy(metric: Callable, shape: tuple[int, ...], remedy: str) -> None:
    array = np.zeros(shape, bool if metric in (mask_iou, boundary_f1) else np.float32)
    with pytest.raises(ValueError, match=remedy):
        metric(array, array)


@pytest.mark.parametrize("name", [name for name in ALONE if METRICS[name].inputs in ("video", "region", "robot")])
@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_floats_of_other_ranges_are_refused_where_they_are_known(name: str, kind: Callable) -> None:
    prediction, target, *rest = inputs(METRICS[name].inputs)
    with pytest.raises(ValueError, match=r"target goes from .* expected floats in \[0, 1\]; divide by 255"):
        METRICS[name].function(kind(prediction), kind(target * 255), *rest)
    with pytest.raises(ValueError, match=r"prediction goes from -.* \(prediction \+ 1\) / 2"):
        METRICS[name].function(kind(prediction * 2 - 1), kind(target), *rest)
    assert traced_jit(METRICS[name].function, (prediction * 255, target, *rest)) is not None, "unknown under a trace"


@pytest.mark.parametrize(
    ("place", "frame", "change", "remedy"),
    [
        ("middle", 2, lambda video: video * 255, "divide by 255"),
        ("last", 4, lambda video: video * 2 - 1, r"\(prediction \+ 1\) / 2"),
        ("first", 0, lambda video: np.where(np.arange(SIDE) == 3, np.nan, video * 255), "divide by 255"),
    ],
)
def test_a_range_that_one_frame_hides_is_seen_in_another(
    place: str, frame: int, change: Callable[[np.ndarray], np.ndarray], remedy: str
) -> None:
    """The others are black or gray, or a pixel is NaN."""
    video = np.full((5, SIDE, SIDE, 3), 0.5, np.float32)
    other = video.copy()
    other[frame] = change(np.linspace(0, 1, SIDE, dtype=np.float32))[:, None]
    with pytest.raises(ValueError, match=f"the {place} frame of prediction goes from .*{remedy}"):
        psnr(other, video)


def test_masks_of_another_video_are_named() -> None:
    prediction, target, mask = inputs("region")
    with pytest.raises(ValueError, match=r"target_mask is \(1, 31, 31\), expected \(2, 31, 31\)"):
        region_lpips(prediction, target, mask[:1])
