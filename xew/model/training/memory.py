"""Estimate of a training run's memory on each device, from shapes alone.

Parameters, optimizer, moving average and gradients are sharded along `fsdp`; activations cover the device's samples in
one part of the batch. `MARGIN` covers XLA's additional buffers.
"""

import math
import os
import sys
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from xew.config import ConfigError
from xew.model.codecs.contract import latent_frames
from xew.model.codecs.vae import abstract_vae
from xew.model.network.blocks import ModelSize, RematName
from xew.model.network.spec import Network
from xew.model.settings.parts import ClipInputs, Encoding
from xew.model.training.step import Trainer
from xew.model.video.frames import TEMPORAL_FACTOR

MARGIN = 1.1
"""Safety factor of the estimate."""
UNROLLED_SHARE = 0.4
"""Share of what a block without recomputing saves that a GPU holds where the blocks are unrolled. XLA then computes norms and
modulations again instead of saving them: configs/fixed.yaml with remat none peaks at 9.5 GB for 4 samples and 33.6 for 16."""


@dataclass(frozen=True)
class Memory:
    """Bytes on each device, by purpose."""

    parts: dict[str, float]
    layout: str
    """Description of the layout."""

    @property
    def total(self) -> float:
        return MARGIN * sum(self.parts.values())

    def line(self) -> str:
        """All parts in one line."""
        shares = ", ".join(f"{name} {size / 1e9:.2f}" for name, size in self.parts.items() if size)
        return f"memory of each device [GB]: {shares}; with a margin of {MARGIN - 1:.0%} {self.total / 1e9:.2f} ({self.layout})"

    def table(self) -> str:
        """One part per line."""
        lines = [f"{name:<28}{size / 1e9:10.3f} GB" for name, size in self.parts.items()]
        total = f"{'total with a margin of ' + format(MARGIN - 1, '.0%'):<28}{self.total / 1e9:10.3f} GB"
        return "\n".join([f"each device, {self.layout}:", *lines, total])


def estimate_memory(trainer: Trainer, encoding: Encoding) -> Memory:
    """Estimate the memory of each device of the trainer's mesh, which may be abstract, with the codec between two chunks."""
    spec, state, params = trainer.spec, trainer.shapes, trainer.network_shapes
    settings, network = spec.settings, spec.network
    devices, fsdp = trainer.mesh.size, trainer.mesh.shape["fsdp"]
    compute = jnp.dtype(network.settings.dtype).itemsize
    weights = sum(math.prod(leaf.sharding.shard_shape(leaf.shape)) for leaf in jax.tree.leaves(params))  # numbers a device
    layer = sum(leaf.size for leaf in jax.tree.leaves(params)) / network.size.depth  # numbers of one layer, about
    summed = settings.accumulate > 1 or settings.chunks > 1
    samples = settings.batch / devices / settings.accumulate
    parts = {
        "parameters": shard_bytes(state.params),
        "frozen parameters": shard_bytes(state.base),
        "optimizer": shard_bytes(state.optimizer),
        "moving average": shard_bytes(state.ema),
        f"rounded to {network.settings.dtype}": weights * compute if compute < 4 else 0.0,
        "gradients": weights * compute + (weights * 4 if summed else 0.0),
        "layers gathered": 2 * compute * layer if fsdp > 1 else 0.0,
        "activations": samples * activation_bytes(network, spec.inputs),
        "autoencoder": codec_bytes(encoding, samples) if settings.chunks == 2 else 0.0,
    }
    layout = f"{devices} devices, state in {fsdp} parts, {samples:g} samples at once on each, remat {network.settings.remat}"
    return Memory(parts, layout)


def shard_bytes(tree: Any) -> float:
    """Bytes on each device of a tree of shapes with shardings."""
    leaves = jax.tree.leaves(tree)
    return float(sum(math.prod(leaf.sharding.shard_shape(leaf.shape)) * leaf.dtype.itemsize for leaf in leaves))


def activation_bytes(network: Network, inputs: ClipInputs) -> float:
    """Bytes of activations of one sample: those saved by every block, and one block's work in the backward pass."""
    settings, size = network.settings, network.size
    tokens = sum(math.prod(grid) for grid in inputs.grids)
    compute, logits = jnp.dtype(settings.dtype).itemsize, logits_bytes(network, tokens)
    saved = tokens * kept_bytes(size, settings.remat, compute) + (logits if settings.remat == "none" else 0.0)
    if settings.remat == "none" and network.unroll > 1:
        saved *= UNROLLED_SHARE
    work = compute * (19 * size.dim + 2 * size.ffn_dim)  # of a token: 14 widths, two of the hidden width, and the norms
    return size.depth * saved + 2 * (tokens * work + logits)


def codec_bytes(encoding: Encoding, samples: float) -> float:
    """Bytes of wan_vae between two chunks: weights, and four of its widest arrays for each sample."""
    settings, clip, size = encoding.codec, encoding.inputs.clip, encoding.autoencoder
    if size is None:
        return 0.0
    frames = TEMPORAL_FACTOR * min(settings.chunk or latent_frames(clip.frames), latent_frames(clip.frames))
    widest = size.decoder_widths[-1] * frames * (clip.height * clip.width // size.patch**2) * jnp.dtype(settings.dtype).itemsize
    weights = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(nnx.state(abstract_vae(size), nnx.Param)))
    return weights + 4 * samples * widest


def kept_bytes(size: ModelSize, remat: RematName, compute: int) -> float:
    """Bytes per token that each block saves for the backward pass."""
    return {
        "full": compute * size.dim,
        "attention": 3 * compute * size.dim,
        "dots": compute * (10 * size.dim + size.ffn_dim),
        # Every step of the norms, modulations and rotations saves its float32 result.
        "none": (104 + 7 * compute) * size.dim + 6 * compute * size.ffn_dim,
    }[remat]


def logits_bytes(network: Network, tokens: int) -> float:
    """Bytes of the pairwise logits of XLA's attention (float32, and rounded); cuDNN's forms none."""
    return 0.0 if network.settings.dtype == "bfloat16" else 8.0 * network.size.heads * tokens**2


def device_memory() -> float:
    """Available bytes of each device; on a CPU, the machine's memory divided by its devices."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"])
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")) / jax.local_device_count()


def check_memory(memory: Memory, ignore: bool = False) -> None:
    """Print the estimated and the available memory. Raises ConfigError if it is insufficient, unless `ignore` is set."""
    available = device_memory()
    if jax.process_index() == 0:
        print(f"{memory.line()}; there is {available / 1e9:.2f}", file=sys.stderr)
    if memory.total > available and not ignore:
        raise ConfigError(
            f"training needs about {memory.total / 1e9:.1f} GB a device, there is {available / 1e9:.1f} GB ({memory.layout}). "
            "Use more devices with a larger mesh.fsdp, --model.remat full, a smaller --train.batch, a larger "
            "--train.accumulate or --train.mu-dtype bfloat16; on a GPU XLA_PYTHON_CLIENT_MEM_FRACTION=0.95 lets JAX use more "
            "than three quarters; --ignore-memory starts anyway."
        )
