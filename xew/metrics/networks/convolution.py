"""Convolutions of images in float32, on NVIDIA's GPUs by matrix units that multiply shorter numbers.

A float32 has 24 significant bits, a TF32 11. With x = high + low, both of which TF32 holds, and the kernel likewise, three of
the four products give 22 bits, and take less time than one in the units for float32. CUTLASS does the same for matrix
products ("3xTF32", its example 27).

Matrix units cut a sum off where float32 would round it: on an H100 that costs about 2e-9 of it for every product added. LPIPS
divides features by their length, so where all of them are nearly 0 such errors grow: with sums of up to 3,456 products one
frame of 121 came out 5e-5 off. Therefore the rows of a kernel are summed apart from each other.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def convolve(x: jax.Array, kernel: jax.Array, stride: int, padding: int) -> jax.Array:
    """Convolution of images as float32 has it, on any device.

    Args:
        x: [n h w i] float32.
        kernel: [k k i o] float32.
        stride: of rows and columns.
        padding: zeros on each of the four sides.

    Returns:
        [n h' w' o] float32.
    """
    by_float32 = functools.partial(in_float32, stride=stride, padding=padding)
    by_tf32 = functools.partial(in_three_parts, stride=stride, padding=padding)
    return lax.platform_dependent(x, kernel, cuda=by_tf32, default=by_float32)


@convolve.defjvp
def _(
    stride: int, padding: int, primals: tuple[jax.Array, jax.Array], tangents: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    (x, kernel), (dx, dkernel) = primals, tangents
    change = in_float32(dx, kernel, stride, padding) + in_float32(x, dkernel, stride, padding)
    return convolve(x, kernel, stride, padding), change


def convolve_quickly(x: jax.Array, kernel: jax.Array, stride: int, padding: int) -> jax.Array:
    """`convolve` of x [n h w i] and kernel [k k i o], both float32, with the device's own choice of products (TF32 on NVIDIA's
    GPUs): [n h' w' o] float32."""
    return _product(x, kernel, stride, padding, lax.Precision.DEFAULT)


def in_float32(x: jax.Array, kernel: jax.Array, stride: int, padding: int) -> jax.Array:
    """`convolve` of x [n h w i] and kernel [k k i o], both float32, by the device's units for float32: [n h' w' o] float32."""
    return _product(x, kernel, stride, padding, lax.Precision.HIGHEST)


def in_three_parts(x: jax.Array, kernel: jax.Array, stride: int, padding: int) -> jax.Array:
    """`convolve` of x [n h w i] and kernel [k k i o], both float32, by three TF32 products: [n h' w' o] float32."""
    if stride > 1:
        x, kernel = _in_blocks(x, kernel, stride, padding)
        stride, padding = 1, 0
    product = functools.partial(_product, stride=stride, padding=padding, precision=lax.Precision.DEFAULT)
    (x_high, x_low), (kernel_high, kernel_low) = _parts(x), _parts(kernel)
    return _row_by_row(x_high, kernel_high, padding) + (product(x_low, kernel_high) + product(x_high, kernel_low))


def _row_by_row(x: jax.Array, kernel: jax.Array, padding: int) -> jax.Array:
    """A product of stride 1 in TF32. The rows of the kernel make outputs of their own, which float32 then adds."""
    rows, _, i, o = kernel.shape
    x = jnp.pad(x, ((0, 0), (padding, padding), (padding, padding), (0, 0)))
    outputs = kernel.transpose(1, 2, 0, 3).reshape(1, rows, i, rows * o)
    apart = _product(x, outputs, stride=1, padding=0, precision=lax.Precision.DEFAULT)
    height = x.shape[1] - rows + 1
    first, *others = (apart[:, row : row + height, :, row * o : (row + 1) * o] for row in range(rows))
    return sum(others, first)


def _parts(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """High and low part of a float32, each rounded to TF32: their sum has 22 bits."""
    rounded = functools.partial(lax.reduce_precision, exponent_bits=8, mantissa_bits=10)
    high = rounded(x)
    return high, rounded(x - high)


def _in_blocks(x: jax.Array, kernel: jax.Array, stride: int, padding: int) -> tuple[jax.Array, jax.Array]:
    """Images and kernel of the same convolution without stride and padding: blocks of pixels become channels."""
    blocks = -(-len(kernel) // stride)
    sides = [(side + 2 * padding - len(kernel)) // stride + blocks for side in x.shape[1:3]]
    edges = [(padding, stride * count - side - padding, 0) for count, side in zip(sides, x.shape[1:3], strict=True)]
    x = lax.pad(x, jnp.float32(0), [(0, 0, 0), *edges, (0, 0, 0)])
    beyond = (0, stride * blocks - len(kernel), 0)
    kernel = lax.pad(kernel, jnp.float32(0), [beyond, beyond, (0, 0, 0), (0, 0, 0)])
    return _fold(x, stride), jnp.moveaxis(_fold(jnp.moveaxis(kernel, 3, 0), stride), 0, 3)


def _fold(x: jax.Array, side: int) -> jax.Array:
    """[n h w i] -> [n h/side w/side side*side*i]."""
    n, h, w, i = x.shape
    blocks = x.reshape(n, h // side, side, w // side, side, i).transpose(0, 1, 3, 2, 4, 5)
    return blocks.reshape(n, h // side, w // side, side * side * i)


def _product(x: jax.Array, kernel: jax.Array, stride: int, padding: int, precision: lax.Precision) -> jax.Array:
    names = ("NHWC", "HWIO", "NHWC")
    edges = ((padding, padding),) * 2
    return lax.conv_general_dilated(x, kernel, (stride, stride), edges, dimension_numbers=names, precision=precision)
