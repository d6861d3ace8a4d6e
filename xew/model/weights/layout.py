"""Layouts of modules in checkpoints: keys of tensors, and the order of their axes."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from flax import nnx

LISTED = 6
"""Number of names that an error lists."""


@dataclass(frozen=True)
class Source:
    """Tensors of one leaf in a checkpoint."""

    keys: tuple[str, ...]
    """Key of the tensor, or of the tensor of each layer if `is_stacked`."""
    layout: Literal["as_is", "linear", "conv", "patches", "ones", "leading_ones"] = "as_is"
    """Conversion of the tensor's axes to the leaf's:

    as_is    unchanged
    linear   [out in] -> [in out]
    conv     [out in *kernel] -> [*kernel in out], a kernel of any rank
    patches  [out in *kernel] -> [in*kernel out]: a convolution whose stride is its kernel, as a matrix (`kernel` given)
    ones     [*shape 1 1 1] -> [*shape]: a vector written with trailing ones (`kernel` given)
    leading_ones  [1 1 *shape] -> [*shape] (`kernel` given)
    """
    kernel: tuple[int, ...] = ()
    """Shape of the kernel of `patches`, or of the ones of `ones` and `leading_ones`."""
    stacked: bool | None = None
    """Whether layers are stacked on the leading axis (default: if there are several keys)."""

    @property
    def is_stacked(self) -> bool:
        """Whether the leaf has a leading axis of layers, one for each key."""
        return len(self.keys) > 1 if self.stacked is None else self.stacked


Layout = Mapping[str, Source]
"""Source of each leaf by path, as "blocks.self_attn.q.kernel"."""


def checkpoint_shapes(module: nnx.Module, layout: Layout) -> dict[str, tuple[int, ...]]:
    """Shape of every tensor of the layout by key; the module may be abstract (of `nnx.eval_shape`)."""
    leaves = module_leaves(module, layout)
    return {key: tensor_shape(leaves[path].shape, source) for path, source in layout.items() for key in source.keys}


def module_leaves(module: nnx.Module, layout: Layout) -> dict[str, nnx.Variable]:
    """The leaves of a module by path. Raises ValueError if the layout names other leaves or numbers of layers."""
    leaves = {".".join(map(str, path)): leaf for path, leaf in nnx.to_flat_state(nnx.state(module))}
    unknown = [path for path in layout if path not in leaves]
    if unknown:
        raise ValueError(f"the layout names leaves that {type(module).__name__} lacks: {list_some(unknown)}")
    for path, source in layout.items():
        layers = leaves[path].shape[0] if source.is_stacked else 1
        if layers != len(source.keys):
            raise ValueError(f"leaf {path} has {layers} layers and the layout {len(source.keys)} keys")
    return leaves


def tensor_shape(leaf: tuple[int, ...], source: Source) -> tuple[int, ...]:
    """Shape of each of the source's tensors for a leaf of this shape."""
    shape = leaf[1:] if source.is_stacked else leaf
    return AXES[source.layout].to_tensor(np.broadcast_to(np.float32(0), shape), source.kernel).shape


class Axes(NamedTuple):
    """Conversion of axes in both directions; both functions also take the source's kernel."""

    to_leaf: Callable[[np.ndarray, tuple[int, ...]], np.ndarray]
    to_tensor: Callable[[np.ndarray, tuple[int, ...]], np.ndarray]


def _split_patches(leaf: np.ndarray, kernel: tuple[int, ...]) -> np.ndarray:
    return leaf.T.reshape(leaf.shape[1], leaf.shape[0] // int(np.prod(kernel)), *kernel)


AXES: dict[str, Axes] = {
    "as_is": Axes(lambda tensor, _: tensor, lambda leaf, _: leaf),
    "linear": Axes(lambda tensor, _: tensor.T, lambda leaf, _: leaf.T),
    "conv": Axes(
        lambda tensor, _: np.moveaxis(tensor, (0, 1), (-1, -2)),
        lambda leaf, _: np.moveaxis(leaf, (-1, -2), (0, 1)),
    ),
    "patches": Axes(lambda tensor, _: tensor.reshape(len(tensor), -1).T, _split_patches),
    "ones": Axes(
        lambda tensor, kernel: tensor.reshape(tensor.shape[: tensor.ndim - len(kernel)]),
        lambda leaf, kernel: leaf.reshape(*leaf.shape, *kernel),
    ),
    "leading_ones": Axes(
        lambda tensor, kernel: tensor.reshape(tensor.shape[len(kernel) :]),
        lambda leaf, kernel: leaf.reshape(*kernel, *leaf.shape),
    ),
}


def list_some(names: Iterable[str]) -> str:
    """The first few names, and the number of others."""
    names = list(names)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more
