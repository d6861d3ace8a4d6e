"""The leaves of a module from a checkpoint: whether its tensors fit, and filling them in.

Reads  `Tensors`, by the module's `Layout`
Writes the leaves of the module

Tensors are read one at a time, so that a checkpoint of 20 GB is never held twice.
"""

from collections.abc import Collection
from fnmatch import fnmatchcase
from typing import Any

import jax
import numpy as np
from flax import nnx

from xew.config import ConfigError
from xew.model.weights.layout import AXES, Layout, Source, list_some, module_leaves, tensor_shape
from xew.model.weights.reading import Tensors


def fill(module: nnx.Module, tensors: Tensors, layout: Layout, *, optional: Collection[str] = ()) -> None:
    """Fill the leaves of a module in place from a checkpoint, in each leaf's own type and on its own devices.

    Leaves that the layout does not name keep their values. An abstract module (of `nnx.eval_shape`) becomes a real one
    but for such leaves.

    The patterns in `optional`, as "flow_stream.*", are of leaves that the checkpoint may lack and of its keys that may be left.

    Raises:
        ConfigError: tensors are missing, left over or misshapen; the first few are named. Nothing has been filled then.
    """
    wanted = check_fit(module, tensors, layout, optional=optional)
    leaves = module_leaves(module, layout)
    for path, source in wanted.items():
        variable = leaves[path]
        value = _leaf_value(tensors, source, variable.shape, np.dtype(variable.dtype))
        if jax.numpy.issubdtype(value.dtype, jax.numpy.inexact) and not np.isfinite(value).all():
            raise ConfigError(f"{tensors.source}: {source.keys[0]} holds NaN or infinite numbers; get the file again.")
        variable.set_value(_place(value, variable.get_value()))


def check_fit(module: nnx.Module, tensors: Tensors, layout: Layout, *, optional: Collection[str] = ()) -> Layout:
    """The leaves that `fill` would fill; raises its errors without reading a tensor."""
    wanted = {path: source for path, source in layout.items() if not _keeps_its_value(path, source, tensors, optional)}
    taken = {key for source in layout.values() for key in source.keys}
    foreign = [key for key in tensors if key not in taken and not _matches(key, optional)]
    missing = [f"{key} (for {path})" for path, source in wanted.items() for key in source.keys if key not in tensors]
    leaves = module_leaves(module, layout)
    misshapen = [
        f"{key} is {list(tensors.shape(key))}, the model's {path} needs {list(shape)}"
        for path, source in wanted.items()
        for shape in (tensor_shape(leaves[path].shape, source),)
        for key in source.keys
        if key in tensors and tensors.shape(key) != shape
    ]
    faults = {"missing": missing, "of another shape": misshapen, "not of this model": foreign}
    found = [f"{len(names)} {kind}: {list_some(names)}" for kind, names in faults.items() if names]
    if found:
        raise ConfigError(
            f"{tensors.source} does not fit the model: " + "; ".join(found) + ". Choose the model size that it was trained"
            " with, or another file."
        )
    return wanted


def _keeps_its_value(path: str, source: Source, tensors: Tensors, optional: Collection[str]) -> bool:
    """Whether a leaf is to keep its value: optional, and the checkpoint has none of its tensors."""
    return _matches(path, optional) and not any(key in tensors for key in source.keys)


def _matches(name: str, patterns: Collection[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _leaf_value(tensors: Tensors, source: Source, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """A leaf of `shape` from its tensors: each is read, converted into its place, and let go."""
    value = np.empty(shape, dtype)
    for place, key in zip(value if source.is_stacked else (value,), source.keys, strict=True):
        np.copyto(place, AXES[source.layout].to_leaf(tensors[key], source.kernel), casting="unsafe")
    return value


def _place(value: np.ndarray, like: Any) -> jax.Array:
    """Put a value where the leaf lay before; each process gives its own devices their shards."""
    sharding = getattr(like, "sharding", None)
    if sharding is None:
        return jax.device_put(value)
    return jax.make_array_from_callback(value.shape, sharding, lambda index: value[index])
