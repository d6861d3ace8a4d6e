"""Opening checkpoints of other projects as `Tensors` by key, read lazily and never unpickled without `weights_only`."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
from safetensors import SafetensorError, safe_open

from xew.config import ConfigError
from xew.files import read_json
from xew.model.weights.layout import list_some

PREFIXES = ("pipe.dit.", "pipe.", "model.diffusion_model.", "model.", "module.")
"""Prefixes of wrappers, removed from keys (the first that matches)."""
STATE_DICTS = ("state_dict", "model_state_dict", "model")
"""Keys of a nested state dict in a .pth."""


@dataclass(frozen=True)
class Entry:
    """One tensor of a checkpoint, not yet read."""

    shape: tuple[int, ...]
    read: Callable[[], np.ndarray]
    """Function that gives the tensor [...], of `shape`."""


class Tensors(Mapping):
    """Tensors of a checkpoint by key, read lazily.

    The mapping has no type parameters, because checking them at run time would read a tensor.
    """

    def __init__(self, entries: Mapping[str, Entry], source: Path) -> None:
        self.entries, self.source = dict(entries), source

    def __getitem__(self, key: str) -> np.ndarray:
        """The tensor [...] of a key. Raises ConfigError if its type is unknown, such as a float of 8 bits."""
        entry = self.entries[key]
        try:
            return entry.read()
        except Exception as error:  # the libraries raise many types
            raise ConfigError(f"{self.source}: {key} cannot be read ({error}); get these weights in bfloat16.") from error

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __contains__(self, key: object) -> bool:
        return key in self.entries

    def shape(self, key: str) -> tuple[int, ...]:
        """Shape of a tensor, without reading it."""
        return self.entries[key].shape

    @property
    def config(self) -> dict[str, Any]:
        """Content of config.json next to the checkpoint, as in diffusers, or {}. Raises ConfigError if it is broken."""
        config = (self.source if self.source.is_dir() else self.source.parent) / "config.json"
        if not config.exists():
            return {}
        try:
            content = read_json(config)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{config} cannot be read: {error}; download it again, or delete it.") from error
        if not isinstance(content, dict):
            raise ConfigError(f"{config} holds a {type(content).__name__}, expected keys and values; download it again.")
        return content


def read_tensors(path: Path) -> Tensors:
    """Open a checkpoint: NumPy arrays by key (bfloat16 of ml_dtypes), without the prefixes of wrappers.

    Args:
        path: a .safetensors file, a *.safetensors.index.json, a folder that holds either, or a .pth / .pt state dict
            (needs PyTorch; loaded with `weights_only`).

    Raises:
        ConfigError: there is no such file, it is broken, or it is of another kind.
    """
    path = Path(path)
    try:
        return Tensors(_strip_prefixes(_open(path), path), path)
    except SafetensorError as error:
        raise ConfigError(f"{path} is not a whole safetensors file ({error}); download it again.") from error
    except OSError as error:
        raise ConfigError(f"cannot read the weights {path}: {error.strerror or error}.") from error


def _read_torch(tensor: Any) -> np.ndarray:
    """Convert a tensor [...] of PyTorch to NumPy."""
    tensor = tensor.detach()
    if str(tensor.dtype) != "torch.bfloat16":
        return tensor.numpy()
    import torch

    return tensor.contiguous().view(torch.uint16).numpy().view(ml_dtypes.bfloat16)


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
    raise ConfigError(f"{path} is not a known kind of checkpoint; expected .safetensors, .safetensors.index.json, .pth or .pt.")


def _open_folder(folder: Path) -> dict[str, Entry]:
    """Open a folder by its index, else all its .safetensors, else its only .pth."""
    files = sorted(file for file in folder.iterdir() if not file.name.startswith("."))
    indexes = [file for file in files if file.name.endswith(".safetensors.index.json")]
    shards = [file for file in files if file.suffix == ".safetensors"]
    pickles = [file for file in files if file.suffix in (".pth", ".pt")]
    if len(indexes) == 1:
        return _open_index(indexes[0])
    if not indexes and shards:
        return _merge((shard, _open_safetensors(shard)) for shard in shards)
    if not indexes and len(pickles) == 1:
        return _open_torch(pickles[0])
    names = [file.name for file in (*indexes, *pickles)]
    content = f"several checkpoints ({', '.join(names)}); name one of them" if names else "no .safetensors, .pth or .pt"
    raise ConfigError(f"{folder} holds {content}.")


def _open_index(index: Path) -> dict[str, Entry]:
    """Open the shards of an index, which must be next to it."""
    try:
        names = read_json(index)["weight_map"]
        shards = sorted(set(names.values()))
        elsewhere = [name for name in shards if Path(name).name != name or "\\" in name or not name.endswith(".safetensors")]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{index} is no index of safetensors (no weight_map of keys to files); download it again.") from error
    if elsewhere:
        raise ConfigError(
            f"{index} names files that are no .safetensors next to it: {list_some(map(repr, elsewhere))}; do not use it."
        )
    absent = [name for name in shards if not (index.parent / name).is_file()]
    if absent:
        raise ConfigError(f"{index} names missing shards: {list_some(absent)}; download them into {index.parent}.")
    entries = _merge((index.parent / name, _open_safetensors(index.parent / name)) for name in shards)
    lost = [key for key in names if key not in entries]
    if lost:
        raise ConfigError(f"{index} names tensors that its shards lack: {list_some(lost)}; download the shards again.")
    return entries


def _open_safetensors(path: Path) -> dict[str, Entry]:
    try:
        file = safe_open(path, framework="numpy")
    except SafetensorError as error:
        raise ConfigError(f"{path} is not a whole safetensors file ({error}); download it again.") from error
    shapes = {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}  # noqa: SIM118 (no mapping)
    return {key: Entry(shape, partial(file.get_tensor, key)) for key, shape in shapes.items()}


def _open_torch(path: Path) -> dict[str, Entry]:
    try:
        import torch
    except ImportError as error:
        raise ConfigError(f"reading {path} needs PyTorch: pip install torch; or convert it to .safetensors first.") from error
    from xew.metrics.networks.pickles import read_torch_file

    content = read_torch_file(path, "PyTorch")
    state = content if isinstance(content, Mapping) else {}
    state = next((state[name] for name in STATE_DICTS if isinstance(state.get(name), Mapping)), state)
    tensors = {
        str(key): Entry(tuple(value.shape), partial(_read_torch, value))
        for key, value in state.items()
        if isinstance(value, torch.Tensor)
    }
    if not tensors:
        raise ConfigError(f"{path} holds no tensors by name; expected a state dict.")
    return tensors


def _merge(files: Iterable[tuple[Path, Mapping[str, Entry]]]) -> dict[str, Entry]:
    merged: dict[str, Entry] = {}
    for path, entries in files:
        twice = merged.keys() & entries.keys()
        if twice:
            raise ConfigError(f"{path} repeats tensors of another file next to it: {list_some(sorted(twice))}; name one file.")
        merged |= entries
    return merged


def _strip_prefixes(entries: Mapping[str, Entry], path: Path) -> dict[str, Entry]:
    bare: dict[str, Entry] = {}
    for key, entry in entries.items():
        name = key.removeprefix(next((prefix for prefix in PREFIXES if key.startswith(prefix)), ""))
        if name in bare:
            raise ConfigError(f"{path} holds {name} twice, under different prefixes; keep one of them.")
        bare[name] = entry
    return bare
