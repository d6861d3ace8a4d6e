"""Writing modules as checkpoints of other projects: .safetensors, or a folder of shards with their index."""

import itertools
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import numpy as np
from flax import nnx
from safetensors import SafetensorError
from safetensors.numpy import save_file

from xew.config import ConfigError
from xew.files import replacing, write_text
from xew.model.weights.layout import AXES, Layout, module_leaves, tensor_shape

SHARD_BYTES = 5_000_000_000
"""Largest size of a shard [bytes]."""


def save_weights(module: nnx.Module, path: Path, layout: Layout) -> None:
    """Write a module's leaves, each in its type, under the names of a layout.

    A path that does not end in .safetensors becomes a folder of shards of at most 5 GB and their index, with diffusers' names.

    Raises:
        ConfigError: the file cannot be written.
    """
    path = Path(path)
    leaves = module_leaves(module, layout)
    try:
        if path.suffix == ".safetensors":
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, dict(_convert(leaves, layout)))
        else:
            path.mkdir(parents=True, exist_ok=True)
            _write_shards(path, leaves, layout)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"cannot write the weights {path}: {error}.") from error


def _convert(leaves: Mapping[str, nnx.Variable], layout: Layout) -> Iterator[tuple[str, np.ndarray]]:
    """Every key and tensor; a leaf is copied from the device once for all its layers."""
    for path, source in layout.items():
        value = np.asarray(jax.device_get(leaves[path].get_value()))
        for key, layer in zip(source.keys, value if source.is_stacked else (value,), strict=True):
            yield key, np.ascontiguousarray(AXES[source.layout].to_tensor(layer, source.kernel))


def _write(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """Write a file atomically, with the user's default permissions."""
    with replacing(path, within=path.parent) as partial:
        save_file(tensors, partial, metadata={"format": "pt"})
        mask = os.umask(0)  # the library's files are readable by their owner only
        os.umask(mask)
        partial.chmod(0o666 & ~mask)


def _write_shards(folder: Path, leaves: Mapping[str, nnx.Variable], layout: Layout) -> None:
    """Write shards, then their index; names hold the number of shards, so they are planned first."""
    sizes = {
        key: int(np.prod(tensor_shape(leaves[path].shape, source))) * np.dtype(leaves[path].dtype).itemsize
        for path, source in layout.items()
        for key in source.keys
    }
    plan = _plan_shards(sizes, SHARD_BYTES)
    count = max(plan.values(), default=0) + 1
    names = [f"diffusion_pytorch_model-{shard + 1:05d}-of-{count:05d}.safetensors" for shard in range(count)]
    for shard, tensors in itertools.groupby(_convert(leaves, layout), key=lambda item: plan[item[0]]):
        _write(folder / names[shard], dict(tensors))
    index = {"metadata": {"total_size": sum(sizes.values())}, "weight_map": {key: names[shard] for key, shard in plan.items()}}
    text = json.dumps(index, indent=2, sort_keys=True)
    write_text(folder / "diffusion_pytorch_model.safetensors.index.json", text, within=folder)


def _plan_shards(sizes: Mapping[str, int], limit: int) -> dict[str, int]:
    """The shard of each tensor, in order; a shard exceeds the limit only for a single larger tensor."""
    plan, shard, total = {}, 0, 0
    for key, size in sizes.items():
        if total and total + size > limit:
            shard, total = shard + 1, 0
        plan[key], total = shard, total + size
    return plan
