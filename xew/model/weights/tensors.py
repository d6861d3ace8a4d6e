"""Checkpoints of other projects: their tensors into our modules, and back out under their names.

Reads  .safetensors, *.safetensors.index.json, a folder of either, .pth and .pt (PyTorch state dicts, `weights_only`)
Writes .safetensors, or a folder of shards with their index

A module's `Layout` says for each of its leaves which tensors it comes from and how their axes are ordered. Tensors are
read one at a time, so that a checkpoint of 20 GB is never held twice, and nothing is ever unpickled freely.
"""

import itertools
import json
import os
import pickle
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import jax
import ml_dtypes
import numpy as np
from flax import nnx
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from xew.config import ConfigError
from xew.files import replacing

PREFIXES = ("pipe.dit.", "pipe.", "model.diffusion_model.", "model.", "module.")
"""Wrappers' names in front of keys, taken off (the longest that fits)."""
STATE_DICTS = ("state_dict", "model_state_dict", "model")
"""Where a .pth may hold its tensors one level down."""
SHARD_BYTES = 5_000_000_000
LISTED = 6
"""How many faults of a kind an error names."""


@dataclass(frozen=True)
class Source:
    """Where one leaf of a module comes from in somebody's checkpoint."""

    keys: tuple[str, ...]
    """One tensor, or one for each layer; `stacked` tells which."""
    layout: Literal["as_is", "linear", "conv", "patches", "ones", "leading_ones"] = "as_is"
    """How the tensor's axes become the leaf's.

    as_is    unchanged
    linear   [out in] -> [in out]
    conv     [out in *kernel] -> [*kernel in out], a kernel of any rank
    patches  [out in *kernel] -> [in*kernel out]: a convolution whose stride is its kernel, as a matrix (`kernel` given)
    ones     [*shape 1 1 1] -> [*shape]: a vector written with trailing ones (`kernel` given)
    leading_ones  [1 1 *shape] -> [*shape] (`kernel` given)
    """
    kernel: tuple[int, ...] = ()
    """The kernel of `patches`, the ones of `ones` and `leading_ones`."""
    stacked: bool | None = None
    """Layers stacked on the leading axis; by default so if there are several keys."""

    @property
    def is_stacked(self) -> bool:
        return len(self.keys) > 1 if self.stacked is None else self.stacked


Layout = Mapping[str, Source]
"""Path of a leaf, as "blocks.self_attn.q.kernel", to where it comes from."""


class Entry(Protocol):
    """One tensor of a checkpoint, not yet read."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def read(self) -> np.ndarray: ...


class Tensors(Mapping[str, np.ndarray]):
    """The tensors of a checkpoint by key; each is read when it is asked for."""

    def __init__(self, entries: Mapping[str, Entry], source: Path) -> None:
        self.entries, self.source = dict(entries), source

    def __getitem__(self, key: str) -> np.ndarray:
        return self.entries[key].read()

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __contains__(self, key: object) -> bool:
        return key in self.entries

    def shape(self, key: str) -> tuple[int, ...]:
        """Shape of a tensor, without reading it."""
        return self.entries[key].shape


def read_tensors(path: Path) -> Tensors:
    """Open a checkpoint: numpy arrays by key (bfloat16 as of ml_dtypes), read lazily; wrappers' prefixes are taken off.

    Args:
        path: a .safetensors file, a *.safetensors.index.json, a folder that holds either, or a .pth / .pt state dict
            (needs PyTorch; loaded with `weights_only`, so that it can hold nothing but tensors).

    Raises:
        ConfigError: there is no such file, it is broken, or it is of another kind.
    """
    path = Path(path)
    try:
        return Tensors(_without_prefixes(_open(path), path), path)
    except SafetensorError as error:
        raise ConfigError(f"{path} is no whole safetensors file ({error}); download it again.") from error
    except OSError as error:
        raise ConfigError(f"cannot read the weights {path}: {error.strerror or error}.") from error


def fill(module: nnx.Module, tensors: Tensors, layout: Layout, *, optional: Collection[str] = ()) -> None:
    """Fill the leaves of a module in place from a checkpoint, in each leaf's own type and on its own devices.

    Leaves that the layout does not name keep their values. An abstract module (of `nnx.eval_shape`) becomes a real one
    but for such leaves.

    Args:
        module: whose leaves are filled.
        tensors: of the checkpoint, from `read_tensors`.
        layout: where each leaf comes from.
        optional: patterns (as "flow_stream.*") of leaves that the checkpoint may lack, and of its keys that may be left.

    Raises:
        ConfigError: tensors are missing, left over or misshapen; the first few are named. Nothing has been filled then.
    """
    wanted = check_fit(module, tensors, layout, optional=optional)
    leaves = _leaves(module, layout)
    for path, source in wanted.items():
        variable = leaves[path]
        value = _leaf_value(tensors, source, variable.shape, np.dtype(variable.dtype))
        variable.set_value(_placed(value, variable.get_value()))


def check_fit(module: nnx.Module, tensors: Tensors, layout: Layout, *, optional: Collection[str] = ()) -> Layout:
    """The leaves that `fill` would fill; raises its errors without reading a tensor."""
    wanted = {path: source for path, source in layout.items() if not _may_lack(path, source, tensors, optional)}
    _check(_leaves(module, layout), tensors, wanted, _foreign(tensors, layout, optional))
    return wanted


def save_weights(module: nnx.Module, path: Path, layout: Layout) -> None:
    """Write a module's leaves under another project's names.

    Args:
        module: whose leaves are written, each in its own type.
        path: a file that ends in .safetensors, or a folder, which then gets shards of at most 5 GB and their index under
            the names that diffusers looks for.
        layout: where each leaf goes; the inverse of loading.

    Raises:
        ConfigError: the file cannot be written.
    """
    path = Path(path)
    leaves = _leaves(module, layout)
    try:
        if path.suffix == ".safetensors":
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, dict(_written(leaves, layout)))
        else:
            path.mkdir(parents=True, exist_ok=True)
            _write_shards(path, leaves, layout)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"cannot write the weights {path}: {error}.") from error


def checkpoint_shapes(module: nnx.Module, layout: Layout) -> dict[str, tuple[int, ...]]:
    """Key -> shape of every tensor that the layout asks for; works on modules of `nnx.eval_shape`."""
    leaves = _leaves(module, layout)
    return {key: _tensor_shape(leaves[path].shape, source) for path, source in layout.items() for key in source.keys}


def _placed(value: np.ndarray, like: Any) -> jax.Array:
    """A value where the leaf lay before; each process gives its own devices their parts."""
    sharding = getattr(like, "sharding", None)
    if sharding is None:
        return jax.device_put(value)
    return jax.make_array_from_callback(value.shape, sharding, lambda index: value[index])


# Axes.


class Axes(NamedTuple):
    """How one layout turns a tensor into a leaf, and back; both take the kernel of the source."""

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


def _tensor_shape(leaf: tuple[int, ...], source: Source) -> tuple[int, ...]:
    """Shape of one of the source's tensors for a leaf of this shape (views of one number: nothing is allocated)."""
    shape = leaf[1:] if source.is_stacked else leaf
    return AXES[source.layout].to_tensor(np.broadcast_to(np.float32(0), shape), source.kernel).shape


def _leaf_value(tensors: Tensors, source: Source, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """A leaf from its tensors: each is read, turned, converted into its place, and let go."""
    value = np.empty(shape, dtype)
    for place, key in zip(value if source.is_stacked else (value,), source.keys, strict=True):
        np.copyto(place, AXES[source.layout].to_leaf(tensors[key], source.kernel), casting="unsafe")
    return value


def _written(leaves: Mapping[str, nnx.Variable], layout: Layout) -> Iterator[tuple[str, np.ndarray]]:
    """Every tensor under its key; a leaf comes from the device once, for all its layers."""
    for path, source in layout.items():
        value = np.asarray(jax.device_get(leaves[path].get_value()))
        for key, part in zip(source.keys, value if source.is_stacked else (value,), strict=True):
            yield key, np.ascontiguousarray(AXES[source.layout].to_tensor(part, source.kernel))


# What fits.


def _leaves(module: nnx.Module, layout: Layout) -> dict[str, nnx.Variable]:
    leaves = {".".join(map(str, path)): leaf for path, leaf in nnx.to_flat_state(nnx.state(module))}
    unknown = [path for path in layout if path not in leaves]
    if unknown:
        raise ValueError(f"the layout names leaves that {type(module).__name__} lacks: {_some(unknown)}")
    for path, source in layout.items():
        layers = leaves[path].shape[0] if source.is_stacked else 1
        if layers != len(source.keys):
            raise ValueError(f"leaf {path} has {layers} layers and the layout {len(source.keys)} keys")
    return leaves


def _may_lack(path: str, source: Source, tensors: Tensors, optional: Collection[str]) -> bool:
    """Whether a leaf is to keep its value: optional, and the checkpoint has none of its tensors."""
    return _matches(path, optional) and not any(key in tensors for key in source.keys)


def _foreign(tensors: Tensors, layout: Layout, optional: Collection[str]) -> list[str]:
    taken = {key for source in layout.values() for key in source.keys}
    return [key for key in tensors if key not in taken and not _matches(key, optional)]


def _matches(name: str, patterns: Collection[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def _check(leaves: Mapping[str, nnx.Variable], tensors: Tensors, layout: Layout, foreign: list[str]) -> None:
    """Raises ConfigError with all that does not fit, the first few of each kind by name."""
    missing = [f"{key} (for {path})" for path, source in layout.items() for key in source.keys if key not in tensors]
    misshapen = [
        f"{key} is {list(tensors.shape(key))}, the model's {path} needs {list(shape)}"
        for path, source in layout.items()
        for shape in (_tensor_shape(leaves[path].shape, source),)
        for key in source.keys
        if key in tensors and tensors.shape(key) != shape
    ]
    faults = {"missing": missing, "of another shape": misshapen, "not of this model": foreign}
    found = [f"{len(names)} {kind}: {_some(names)}" for kind, names in faults.items() if names]
    if found:
        raise ConfigError(
            f"{tensors.source} does not fit the model: " + "; ".join(found) + ". Choose the model size that it was trained"
            " with, or another file."
        )


def _some(names: Iterable[str]) -> str:
    names = list(names)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more


# Files.


@dataclass(frozen=True)
class _SafetensorsEntry:
    file: Any
    key: str

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.file.get_slice(self.key).get_shape())

    def read(self) -> np.ndarray:
        return self.file.get_tensor(self.key)


@dataclass(frozen=True)
class _TorchEntry:
    tensor: Any

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.tensor.shape)

    def read(self) -> np.ndarray:
        tensor = self.tensor.detach()
        if str(tensor.dtype) == "torch.bfloat16":  # NumPy has no such type of its own: the same bits by another name
            import torch

            return tensor.contiguous().view(torch.uint16).numpy().view(ml_dtypes.bfloat16)
        return tensor.numpy()


def _open(path: Path) -> dict[str, Entry]:
    if path.is_dir():
        return _open_folder(path)
    if not path.is_file():
        raise ConfigError(f"there are no weights at {path}; give a file or folder that exists.")
    if path.name.endswith(".safetensors.index.json"):
        return _open_index(path)
    if path.suffix == ".safetensors":
        return _open_safetensors(path)
    if path.suffix in (".pth", ".pt"):
        return _open_torch(path)
    raise ConfigError(
        f"{path} is no checkpoint that is known here; expected .safetensors, .safetensors.index.json, .pth or .pt."
    )


def _open_folder(folder: Path) -> dict[str, Entry]:
    """By its index if there is one; else all its .safetensors; else its only .pth."""
    indexes, parts = sorted(folder.glob("*.safetensors.index.json")), sorted(folder.glob("*.safetensors"))
    pickles = sorted(file for file in folder.iterdir() if file.suffix in (".pth", ".pt"))
    if len(indexes) == 1:
        return _open_index(indexes[0])
    if not indexes and parts:
        return _merged((part, _open_safetensors(part)) for part in parts)
    if not indexes and len(pickles) == 1:
        return _open_torch(pickles[0])
    choices = [file.name for file in (*indexes, *pickles)]
    found = f"several checkpoints ({', '.join(choices)}); name one of them" if choices else "no .safetensors, .pth or .pt"
    raise ConfigError(f"{folder} holds {found}.")


def _open_index(index: Path) -> dict[str, Entry]:
    """Shards named by an index; they lie beside it, and whatever points elsewhere is refused."""
    try:
        names = json.loads(index.read_text())["weight_map"]
        shards = sorted(set(names.values()))
        elsewhere = [name for name in shards if Path(name).name != name or "\\" in name or not name.endswith(".safetensors")]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{index} is no index of safetensors (no weight_map of keys to files); download it again.") from error
    if elsewhere:
        raise ConfigError(
            f"{index} names files that are no .safetensors beside it: {_some(map(repr, elsewhere))}; do not use it."
        )
    absent = [name for name in shards if not (index.parent / name).is_file()]
    if absent:
        raise ConfigError(f"{index} names shards that are not there: {_some(absent)}; download them into {index.parent}.")
    entries = _merged((index.parent / name, _open_safetensors(index.parent / name)) for name in shards)
    lost = [key for key in names if key not in entries]
    if lost:
        raise ConfigError(f"{index} names tensors that its shards lack: {_some(lost)}; download the shards again.")
    return entries


def _open_safetensors(path: Path) -> dict[str, Entry]:
    try:
        file = safe_open(path, framework="numpy")
    except SafetensorError as error:
        raise ConfigError(f"{path} is no whole safetensors file ({error}); download it again.") from error
    return {key: _SafetensorsEntry(file, key) for key in file.keys()}  # noqa: SIM118 (no mapping)


def _open_torch(path: Path) -> dict[str, Entry]:
    try:
        import torch
    except ImportError as error:
        raise ConfigError(f"reading {path} needs PyTorch: pip install torch; or convert it to .safetensors first.") from error
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except pickle.UnpicklingError as error:
        raise ConfigError(
            f"{path} holds more than tensors, or is broken, and is not opened; get it as .safetensors."
        ) from error
    except (RuntimeError, EOFError, ValueError) as error:
        raise ConfigError(f"{path} is no whole PyTorch file ({str(error).splitlines()[0]}); download it again.") from error
    state = _state_dict(content)
    tensors = {str(key): _TorchEntry(value) for key, value in state.items() if isinstance(value, torch.Tensor)}
    if not tensors:
        raise ConfigError(f"{path} holds no tensors by name; expected a state dict.")
    return dict(tensors)


def _state_dict(content: Any) -> Mapping[str, Any]:
    """The mapping of names to tensors in what a .pth holds."""
    if not isinstance(content, Mapping):
        return {}
    inner = [content[name] for name in STATE_DICTS if isinstance(content.get(name), Mapping)]
    return inner[0] if inner else content


def _merged(files: Iterable[tuple[Path, Mapping[str, Entry]]]) -> dict[str, Entry]:
    merged: dict[str, Entry] = {}
    for path, entries in files:
        twice = merged.keys() & entries.keys()
        if twice:
            raise ConfigError(f"{path} repeats tensors of another file beside it: {_some(sorted(twice))}; name one file.")
        merged |= entries
    return merged


def _without_prefixes(entries: Mapping[str, Entry], path: Path) -> dict[str, Entry]:
    bare: dict[str, Entry] = {}
    for key, entry in entries.items():
        name = key.removeprefix(next((prefix for prefix in PREFIXES if key.startswith(prefix)), ""))
        if name in bare:
            raise ConfigError(f"{path} holds {name} twice, under different prefixes; keep one of them.")
        bare[name] = entry
    return bare


def _write(path: Path, tensors: dict[str, np.ndarray]) -> None:
    """All of a file or nothing of it."""
    with replacing(path) as partial:
        save_file(tensors, partial, metadata={"format": "pt"})
        mask = os.umask(0)  # the library lets nobody else read its files; ours are as readable as any of this user's
        os.umask(mask)
        partial.chmod(0o666 & ~mask)


def _write_shards(folder: Path, leaves: Mapping[str, nnx.Variable], layout: Layout) -> None:
    """Shards as they fill up; their names say how many there are, so the plan comes first. The index comes last."""
    sizes = {
        key: int(np.prod(_tensor_shape(leaves[path].shape, source))) * np.dtype(leaves[path].dtype).itemsize
        for path, source in layout.items()
        for key in source.keys
    }
    plan = _plan_shards(sizes, SHARD_BYTES)
    count = max(plan.values(), default=0) + 1
    names = [f"diffusion_pytorch_model-{shard + 1:05d}-of-{count:05d}.safetensors" for shard in range(count)]
    for shard, tensors in itertools.groupby(_written(leaves, layout), key=lambda written: plan[written[0]]):
        _write(folder / names[shard], dict(tensors))
    index = {"metadata": {"total_size": sum(sizes.values())}, "weight_map": {key: names[shard] for key, shard in plan.items()}}
    (folder / "diffusion_pytorch_model.safetensors.index.json").write_text(json.dumps(index, indent=2, sort_keys=True))


def _plan_shards(sizes: Mapping[str, int], limit: int) -> dict[str, int]:
    """The shard of each tensor, in order, none above the limit unless one tensor is."""
    plan, shard, held = {}, 0, 0
    for key, size in sizes.items():
        if held and held + size > limit:
            shard, held = shard + 1, 0
        plan[key], held = shard, held + size
    return plan
