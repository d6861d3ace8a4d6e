"""Names of the leaves of `VideoVae` in files: Wan2.2's, diffusers', and xew's.

xew's files use diffusers' names and add the two statistics of the latents.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx

from xew.config import ConfigError
from xew.model.codecs.vae import VideoVae
from xew.model.weights.filling import fill
from xew.model.weights.layout import Layout, Source
from xew.model.weights.reading import Tensors, read_tensors
from xew.model.weights.writing import save_weights

STATISTICS = ("latents_mean", "latents_std")
"""Leaves that only xew's files and diffusers' config.json hold."""

DIFFUSERS = {
    r"^(post_)?quant\.": r"\g<1>quant_conv.",
    r"^encoder\.stages\.(\d+)\.": r"encoder.down_blocks.\1.",
    r"^decoder\.stages\.(\d+)\.": r"decoder.up_blocks.\1.",
    r"\.blocks\.": ".resnets.",
    r"\.shortcut\.": ".conv_shortcut.",
    r"^encoder(.*)\.resample\.": r"encoder\1.downsampler.",
    r"^decoder(.*)\.resample\.": r"decoder\1.upsampler.",
    r"sampler\.conv\.": "sampler.resample.1.",
    r"sampler\.time\.": "sampler.time_conv.",
    r"\.middle\.first\.": ".mid_block.resnets.0.",
    r"\.middle\.last\.": ".mid_block.resnets.1.",
    r"\.middle\.attention\.": ".mid_block.attentions.0.",
}
"""Patterns of xew's names and their replacements in diffusers, applied in order."""

OFFICIAL = {
    r"^encoder\.stages\.(\d+)\.": r"encoder.downsamples.\1.downsamples.",
    r"^decoder\.stages\.(\d+)\.": r"decoder.upsamples.\1.upsamples.",
    r"\.blocks\.": ".",
    r"\.norm1\.": ".residual.0.",
    r"\.conv1\.": ".residual.2.",
    r"\.norm2\.": ".residual.3.",
    r"\.conv2\.": ".residual.6.",
    r"\.conv\.": ".resample.1.",
    r"\.time\.": ".time_conv.",
    r"\.middle\.first\.": ".middle.0.",
    r"\.middle\.attention\.": ".middle.1.",
    r"\.middle\.last\.": ".middle.2.",
    r"\.conv_in\.": ".conv1.",
    r"\.norm_out\.": ".head.0.",
    r"\.conv_out\.": ".head.2.",
    r"^quant\.": "conv1.",
    r"^post_quant\.": "conv2.",
}
"""The same for Wan2.2, where the resampling layer of a stage is numbered after its blocks."""


def diffusers_layout(vae: VideoVae) -> Layout:
    """Names of diffusers' AutoencoderKLWan; the module may be abstract."""
    return _layout(vae, lambda path: _rename(path, DIFFUSERS))


def official_layout(vae: VideoVae) -> Layout:
    """Names of `Wan2.2_VAE.pth`; the module may be abstract."""

    def name(path: str) -> str:
        blocks = vae.size.blocks + (1 if path.startswith("decoder") else 0)
        return _rename(path.replace(".resample.", f".{blocks}."), OFFICIAL)

    return _layout(vae, name)


def own_layout(vae: VideoVae) -> Layout:
    """Names of the files that xew writes."""
    return {**diffusers_layout(vae), **{name: Source((name,)) for name in STATISTICS}}


def load_vae(vae: VideoVae, path: Path) -> None:
    """Fill an autoencoder from a file in any of the three layouts.

    The statistics of the latents come from the file or from diffusers' config.json next to it, or keep their values.

    Raises:
        ConfigError: the file has another layout or size, or its config.json is damaged.
    """
    tensors = read_tensors(path)
    fill(vae, tensors, _layout_of(vae, tensors), optional=STATISTICS)
    config = tensors.config
    for name in STATISTICS:
        if name in config and name not in tensors:
            getattr(vae, name).set_value(jnp.asarray(_read_statistic(path, name, config[name], vae.size.channels)))


def _read_statistic(path: Path, name: str, values: Any, channels: int) -> np.ndarray:
    """One statistic [c] float32 of config.json next to the weights."""
    numbers = isinstance(values, list) and all(isinstance(value, int | float) for value in values)
    array = np.asarray(values if numbers else [], np.float32)
    if len(array) != channels or not np.isfinite(array).all() or (name == "latents_std" and not (array > 0).all()):
        raise ConfigError(
            f"{name} of config.json next to {path} is not a list of {channels} finite numbers (deviations > 0); get it again."
        )
    return array


def save_vae(vae: VideoVae, path: Path) -> None:
    """Write an autoencoder with its statistics as one .safetensors. Raises ConfigError if it cannot be written."""
    save_weights(vae, path, own_layout(vae))


def _layout_of(vae: VideoVae, tensors: Tensors) -> Layout:
    """The layout of a file, by the name of its first layer."""
    known = {"encoder.conv_in.weight": own_layout, "encoder.conv1.weight": official_layout}
    for key, layout in known.items():
        if key in tensors:
            return layout(vae)
    names = ", ".join(list(tensors)[:3]) or "nothing"
    raise ConfigError(f"{tensors.source} is not an autoencoder of Wan2.2: it holds {names} …, expected {' or '.join(known)}.")


def _layout(vae: VideoVae, name: Callable[[str], str]) -> Layout:
    """A source for every trained leaf."""
    paths = [".".join(map(str, path)) for path, _ in nnx.to_flat_state(nnx.state(vae, nnx.Param))]
    return {path: _source(path, name(path)) for path in paths}


def _source(path: str, name: str) -> Source:
    """PyTorch stores kernels as [out in *kernel], and scales of norms as [c 1 1] or [c 1 1 1]."""
    if path.endswith(".kernel"):
        return Source((name.removesuffix("kernel") + "weight",), "conv")
    if path.endswith(".gamma"):
        return Source((name,), "ones", (1, 1) if ".attention." in path else (1, 1, 1))
    return Source((name,))


def _rename(path: str, patterns: Mapping[str, str]) -> str:
    for pattern, replacement in patterns.items():
        path = re.sub(pattern, replacement, path)
    return path
