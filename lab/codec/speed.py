"""Speed of the packaged codec compared with Wan2.2's autoencoder on the same clips of 320x256 and the same device.

    python -m lab.codec.speed [--frames 33] [--clips 4] [--rounds 5] [--dtype bfloat16] [--wan wan22]

Weights are random. Exits with 1 if a ratio is below the limit (3).
"""

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from flax import nnx

from xew.model.codecs.conv_autoencoder import AUTOENCODERS, ConvAutoencoder
from xew.model.codecs.vae import VAES, VideoVae

HEIGHT, WIDTH = 256, 320


@dataclass(frozen=True)
class Args:
    frames: int = 33
    clips: int = 4
    rounds: int = 5
    dtype: str = "bfloat16"
    ours: str = "base"
    wan: str = "wan22"
    limit: float = 3.0
    """Least ratio of the times."""


def median_seconds(call: Callable[..., jax.Array], *given: Any, rounds: int, shape: tuple[int, ...]) -> float:
    """Median time [s] of a call, after two warm-up calls; checks that the result has this shape and is finite."""
    for _ in range(2):
        out = jax.block_until_ready(call(*given))
    assert out.shape == shape, (out.shape, shape)
    assert bool(jnp.isfinite(out).all())
    seconds = []
    for _ in range(rounds):
        begin = time.perf_counter()
        jax.block_until_ready(call(*given))
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds)


def time_codec(create: Callable[[], Any], size: Any, args: Args) -> dict[str, float]:
    """Median time [s] to encode and to decode all clips."""
    graph = nnx.split(nnx.eval_shape(create))[0]
    state = jax.jit(lambda: nnx.split(create())[1])()
    frames = jax.random.uniform(jax.random.key(0), (args.clips, args.frames, HEIGHT, WIDTH, 3), minval=-1, maxval=1)
    factor, groups = size.spatial_factor, (args.frames - 1) // 4 + 1
    latents = jax.random.normal(jax.random.key(1), (args.clips, groups, HEIGHT // factor, WIDTH // factor, size.channels))
    encode = jax.jit(lambda p, x: nnx.merge(graph, p).encode(x))
    decode = jax.jit(lambda p, z: nnx.merge(graph, p).decode(z))
    return {
        "encode": median_seconds(encode, state, frames, rounds=args.rounds, shape=latents.shape),
        "decode": median_seconds(decode, state, latents, rounds=args.rounds, shape=frames.shape),
    }


def main(args: Args) -> int:
    print(f"{jax.devices()[0].device_kind}, {args.clips} clips of {args.frames} frames of {WIDTH}x{HEIGHT}, {args.dtype}")
    dtype, ours, wan = jnp.dtype(args.dtype), AUTOENCODERS[args.ours], VAES[args.wan]
    mine = time_codec(lambda: ConvAutoencoder(ours, dtype=dtype, rngs=nnx.Rngs(0)), ours, args)
    theirs = time_codec(lambda: VideoVae(wan, dtype=dtype, rngs=nnx.Rngs(0)), wan, args)
    for case in mine:
        print(
            f"{case}: conv_autoencoder {1000 * mine[case]:.1f} ms, wan_vae {1000 * theirs[case]:.1f} ms,"
            f" {theirs[case] / mine[case]:.1f} times"
        )
    return int(min(theirs[case] / mine[case] for case in mine) < args.limit)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
