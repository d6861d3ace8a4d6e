"""FLOPs of a forward pass and a training step, counted on the model, and peak FLOPs of devices."""

from collections.abc import Sequence

import numpy as np

from xew.model.network.blocks import ModelSize
from xew.model.network.spec import Visibility
from xew.model.network.tokens import TokenGrid
from xew.model.settings.parts import TrainSpec

PEAK_FLOPS = {"H100": 989e12, "H200": 989e12, "A100": 312e12}
"""Dense bfloat16 FLOPs per second from data sheets, by part of the device's name."""


def flops_of_step(spec: TrainSpec) -> float:
    """Model FLOPs of one training step over all devices: three forward passes, without recomputation as usual for MFU."""
    network, batch = spec.network, spec.settings.batch
    forward = flops(
        network.size, spec.inputs.grids, batch=batch, channels=network.channels, visibility=network.settings.visibility
    )
    return 3 * spec.settings.chunks * forward


def flops(
    size: ModelSize,
    grids: Sequence[TokenGrid],
    text_tokens: int | None = None,
    batch: int = 1,
    *,
    visibility: Visibility = "joint",
    cached: bool = False,
    channels: int = 48,
) -> float:
    """FLOPs of one forward pass: two for each multiply-add of the matrix products.

    Args:
        size: of the model.
        grids: tokens (t', h', w') of each stream, RGB first, as from `token_grid`.
        text_tokens: by default the model's number.
        batch: number of samples.
        visibility: as of the model.
        cached: whether the condition tokens are read from a cache, as in sampling.
        channels: of the latents.
    """
    text = size.text_tokens if text_tokens is None else text_tokens
    counts = [int(np.prod(grid)) for grid in grids]
    rgb, conditions = counts[0], sum(counts[1:])
    tokens = rgb if cached else rgb + conditions
    pairs = rgb * (rgb + conditions) + (
        0 if cached else conditions * (conditions if visibility == "one_way" else rgb + conditions)
    )
    dim, features = size.dim, channels * int(np.prod(size.patch))
    of_block = tokens * (6 * dim * dim + 2 * dim * size.ffn_dim) + 2 * dim * pairs
    of_text = 2 * text * dim * dim + 2 * dim * tokens * text
    of_ends = (tokens + rgb) * features * dim + text * (size.text_dim + dim) * dim
    return 2.0 * batch * (size.depth * (of_block + of_text) + of_ends)


def peak_flops(device_kind: str) -> float | None:
    """Peak FLOPs per second of a device by its name, or None if unknown."""
    return next((peak for name, peak in PEAK_FLOPS.items() if name in device_kind), None)
