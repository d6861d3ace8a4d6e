"""Convolutions by matrix units for short numbers give float32's results; what a GPU does to its inputs is done here by hand."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export, lax

from xew.metrics.networks import convolution
from xew.metrics.networks.convolution import convolve, in_float32, in_three_parts

LAYERS = [(240, 320, 3, 8, 11, 4, 2), (31, 34, 3, 8, 11, 4, 2), (13, 17, 64, 6, 5, 1, 2), (14, 19, 384, 16, 3, 1, 1)]
"""Height, width, channels in and out, kernel, stride, padding."""
NAMES = ("NHWC", "HWIO", "NHWC")
MOST_PRODUCTS = 300
"""Number of products in a float32 sum whose rounding stays under 3e-7 even when they are added one by one."""


def layer(h: int, w: int, i: int, o: int, size: int, stride: int, padding: int) -> tuple[jax.Array, jax.Array, int, int]:
    rng = np.random.default_rng(8)
    x = jnp.maximum(rng.standard_normal((2, h, w, i), dtype=np.float32), 0)
    return x, jnp.asarray(rng.standard_normal((size, size, i, o), dtype=np.float32)), stride, padding


def exact(x: jax.Array, kernel: jax.Array, stride: int, padding: int) -> np.ndarray:
    with jax.enable_x64(True):
        x, kernel = jnp.asarray(x, jnp.float64), jnp.asarray(kernel, jnp.float64)
        edges = [(padding, padding)] * 2
        return np.asarray(lax.conv_general_dilated(x, kernel, (stride, stride), edges, dimension_numbers=NAMES))


def error(found: jax.Array | np.ndarray, expected: np.ndarray) -> float:
    assert found.shape == expected.shape
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def sum_of_groups(function: Callable[..., jax.Array], x: jax.Array, kernel: jax.Array, *rest: int) -> np.ndarray:
    """A convolution by a function that sees few channels at a time; the results are added in float64.

    The rounding of one long float32 sum depends on its order, which on a CPU follows from the sizes of the caches: sums of
    3,456 products came out 1.9e-7 to 6.8e-7 off with blocks of 192 to all of them.
    """
    channels = max(1, MOST_PRODUCTS // kernel.shape[0] ** 2)
    starts = range(0, x.shape[-1], channels)
    groups = ((x[..., i : i + channels], kernel[:, :, i : i + channels]) for i in starts)
    return sum(np.asarray(function(*group, *rest), np.float64) for group in groups)


@pytest.mark.parametrize("function", [convolve, in_float32, in_three_parts])
@pytest.mark.parametrize("shape", LAYERS)
def test_both_ways_give_the_convolution(shape: tuple[int, ...], function: Callable[..., jax.Array]) -> None:
    given = layer(*shape)
    assert error(sum_of_groups(function, *given), exact(*given)) < 4e-7


@pytest.mark.parametrize("function", [convolve, in_float32, in_three_parts])
@pytest.mark.parametrize("long", ["image", "kernel"])
@pytest.mark.parametrize("shape", LAYERS)
def test_sums_that_float32_holds_are_exact(shape: tuple[int, ...], long: str, function: Callable[..., jax.Array]) -> None:
    """Whole numbers of 12 bits, one more than TF32 has, times -1, 0 and 1: no order of the sum rounds anything."""
    x, kernel, stride, padding = layer(*shape)
    bits = {"image": (4095, 1), "kernel": (1, 4095)}[long]
    x, kernel = (jnp.clip(jnp.round(a * most / 2), -most, most) for a, most in zip((x, kernel), bits, strict=True))
    expected = exact(x, kernel, stride, padding)
    assert np.abs(expected).max() < 2**24 and max(jnp.abs(x).max(), jnp.abs(kernel).max()) == 4095
    np.testing.assert_array_equal(function(x, kernel, stride, padding), expected)


@pytest.mark.parametrize("shape", LAYERS)
def test_rounding_to_tf32_takes_nothing_from_the_parts(shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    given = layer(*shape)
    expected, product = in_three_parts(*given), convolution._product

    def rounded(x: jax.Array, kernel: jax.Array, *rest: Any, **named: Any) -> jax.Array:
        return product(*(lax.reduce_precision(v, 8, 10) for v in (x, kernel)), *rest, **named)

    monkeypatch.setattr(convolution, "_product", rounded)
    np.testing.assert_array_equal(in_three_parts(*given), expected)
    assert error(in_float32(*given), exact(*given)) > 5e-5


def test_sums_are_no_longer_than_a_row_of_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    x, kernel, stride, padding = layer(14, 19, 384, 16, 3, 1, 1)
    seen, product = [], convolution._product

    def watched(x: jax.Array, kernel: jax.Array, *rest: Any, **named: Any) -> jax.Array:
        # The low parts are a two-thousandth of the high ones, and so is what their sums lose.
        seen.append((float(jnp.abs(x).max() * jnp.abs(kernel).max()), np.prod(kernel.shape[:3])))
        return product(x, kernel, *rest, **named)

    monkeypatch.setattr(convolution, "_product", watched)
    in_three_parts(x, kernel, stride, padding)
    assert max(seen)[1] == 3 * 384 and len(seen) == 3


def test_a_gpu_gets_short_numbers_and_others_float32() -> None:
    x, kernel, *_ = layer(14, 19, 8, 6, 3, 1, 1)
    shapes = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in (x, kernel)]
    for platform, products, exact_ones in (("cuda", 3, 0), ("cpu", 1, 1), ("tpu", 1, 1), ("rocm", 1, 1)):
        program = export.export(jax.jit(lambda x, k: convolve(x, k, 1, 1)), platforms=[platform])(*shapes).mlir_module()
        assert program.count("stablehlo.convolution") == products
        assert program.count("#stablehlo<precision HIGHEST>, #stablehlo<precision HIGHEST>") == exact_ones


def test_gradients_are_those_of_float32() -> None:
    x, kernel, stride, padding = layer(13, 17, 5, 7, 5, 1, 2)
    ours, plain = (
        jax.grad(lambda x, k, f=f: jnp.sum(jnp.sin(f(x, k, stride, padding))), argnums=(0, 1))(x, kernel)
        for f in (convolve, in_float32)
    )
    for found, expected in zip(ours, plain, strict=True):
        assert jnp.abs(expected).max() > 0.1
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    forward = jax.jvp(lambda x: convolve(x, kernel, stride, padding), (x,), (x,))
    np.testing.assert_allclose(forward[1], forward[0], rtol=1e-5, atol=1e-4)
