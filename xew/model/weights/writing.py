"""Our modules into checkpoints of other projects.

Reads  the leaves of a module, by its `Layout`
Writes .safetensors, or a folder of shards with their index
"""

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
"""Number of bytes that a shard may hold."""


def save_weights(module: nnx.Module, path: Path, layout: Layout) -> None:
    """Write a module's leaves, each in its own type, under another project's names: the inverse of loading.

    A path that does not end in .safetensors is a folder, which gets shards of at most 5 GB and their index under the names
    that diffusers looks for.

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
    """Every tensor with its key; a leaf comes from the device once, for all its layers."""
    for path, source in layout.items():
        value = np.asarray(jax.device_get(leaves[path].get_value()))
        for key, layer in zip(source.keys, value if source.is_stacked else (value,), strict=True):
            yield key, np.ascontiguousarray(AXES[source.layout].to_tensor(layer, source.kernel))


def _write(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """Write all of a file or nothing of it."""
    with replacing(path) as partial:
        save_file(tensors, partial, metadata={"format": "pt"})
        mask = os.umask(0)  # the library lets nobody else read its files; ours are as readable as any of this user's
        os.umask(mask)
        partial.chmod(0o666 & ~mask)


def _write_shards(folder: Path, leaves: Mapping[str, nnx.Variable], layout: Layout) -> None:
    """Write shards as they fill up; their names say how many there are, so the plan comes first. The index comes last."""
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
    write_text(folder / "diffusion_pytorch_model.safetensors.index.json", json.dumps(index, indent=2, sort_keys=True))


def _plan_shards(sizes: Mapping[str, int], limit: int) -> dict[str, int]:
    """The shard of each tensor, in order, none above the limit unless one tensor is."""
    plan, shard, held = {}, 0, 0
    for key, size in sizes.items():
        if held and held + size > limit:
            shard, held = shard + 1, 0
        plan[key], held = shard, held + size
    return plan
