"""Filling the leaves of a module from a checkpoint, one tensor at a time to save memory."""

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
    """Fill the leaves of a module in place from a checkpoint, in each leaf's type and on its devices.

    Leaves outside the layout keep their values; other leaves of an abstract module (of `nnx.eval_shape`) become real.

    Args:
        module: to fill.
        tensors: of the checkpoint.
        layout: of the module's leaves in the checkpoint.
        optional: patterns, as "flow_stream.*", of leaves that the checkpoint may lack and of keys that are ignored.

    Raises:
        ConfigError: tensors are missing, left over or misshapen; nothing is filled then.
    """
    filled = check_fit(module, tensors, layout, optional=optional)
    leaves = module_leaves(module, layout)
    for path, source in filled.items():
        variable = leaves[path]
        value = _leaf_value(tensors, source, variable.shape, np.dtype(variable.dtype))
        if jax.numpy.issubdtype(value.dtype, jax.numpy.inexact) and not np.isfinite(value).all():
            raise ConfigError(f"{tensors.source}: {source.keys[0]} holds NaN or infinite numbers; get the file again.")
        variable.set_value(_place(value, variable.get_value()))


def check_fit(module: nnx.Module, tensors: Tensors, layout: Layout, *, optional: Collection[str] = ()) -> Layout:
    """The leaves that `fill` would fill; raises its errors without reading a tensor."""
    filled = {
        path: source
        for path, source in layout.items()
        if not _matches(path, optional) or any(key in tensors for key in source.keys)
    }
    known = {key for source in layout.values() for key in source.keys}
    foreign = [key for key in tensors if key not in known and not _matches(key, optional)]
    missing = [f"{key} (for {path})" for path, source in filled.items() for key in source.keys if key not in tensors]
    leaves = module_leaves(module, layout)
    misshapen = [
        f"{key} is {list(tensors.shape(key))}, the model's {path} needs {list(shape)}"
        for path, source in filled.items()
        for shape in (tensor_shape(leaves[path].shape, source),)
        for key in source.keys
        if key in tensors and tensors.shape(key) != shape
    ]
    faults = {"missing": missing, "of another shape": misshapen, "not of this model": foreign}
    differences = [f"{len(names)} {kind}: {list_some(names)}" for kind, names in faults.items() if names]
    if differences:
        raise ConfigError(
            f"{tensors.source} does not fit the model: {'; '.join(differences)}. Choose the model size of the weights, or "
            "another file."
        )
    return filled


def _matches(name: str, patterns: Collection[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _leaf_value(tensors: Tensors, source: Source, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Read a leaf of `shape` [...] from its tensors."""
    value = np.empty(shape, dtype)
    for layer, key in zip(value if source.is_stacked else (value,), source.keys, strict=True):
        np.copyto(layer, AXES[source.layout].to_leaf(tensors[key], source.kernel), casting="unsafe")
    return value


def _place(value: np.ndarray, like: Any) -> jax.Array:
    """Place a value [...] with the sharding of the previous one."""
    sharding = getattr(like, "sharding", None)
    if sharding is None:
        return jax.device_put(value)
    return jax.make_array_from_callback(value.shape, sharding, lambda index: value[index])
