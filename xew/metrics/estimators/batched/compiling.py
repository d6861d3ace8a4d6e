"""Compilation of the estimators' kernels, and those that render points on surfaces, before they are needed.

Warp compiles a module at its first launch, one after another: 27 s of a core for all of them.
"""

import importlib
from collections.abc import Iterable
from pathlib import Path

import warp as wp

from xew.metrics.estimators.batched import flow, tracks
from xew.metrics.estimators.batched.devices import find_gpu

DEFAULT_THREADS = 256
"""Threads of a block of `wp.launch`."""
_HERE = "xew.metrics.estimators.batched"
_RENDERING = "xew.sim_warp.rendering"
THREADS = {
    f"{_HERE}.flow_kernels": flow.THREADS,
    f"{_HERE}.mask_kernels": DEFAULT_THREADS,
    f"{_HERE}.refinement_kernels": DEFAULT_THREADS,
    f"{_HERE}.track_kernels": tracks.THREADS,
    f"{_HERE}.path_kernels": tracks.THREADS,
    f"{_RENDERING}.raster_kernels": DEFAULT_THREADS,
    f"{_RENDERING}.shading_kernels": DEFAULT_THREADS,
}
"""Threads of a block by module of kernels; a module is compiled for one number of threads."""
OF_MASKS = (f"{_HERE}.flow_kernels", f"{_HERE}.mask_kernels")
OF_TRACKS = tuple(name for name in THREADS if name.startswith(_HERE))
OF_SURFACES = tuple(name for name in THREADS if name.startswith(_RENDERING))
"""Modules of kernels by their use."""


def missing_kernels(modules: Iterable[str]) -> list[str]:
    """The modules, keys of THREADS, that Warp's cache lacks for this machine's GPUs."""
    archs = {gpu.get_cuda_compile_arch() for gpu in _gpus()}
    return [name for name in dict.fromkeys(modules) if not all(is_compiled(name, arch) for arch in archs)]


def gpu_names() -> list[str]:
    """Names of this machine's kinds of GPUs."""
    return sorted({gpu.name for gpu in _gpus()})


def _gpus() -> list[wp.Device]:
    """All GPUs; a context is not made."""
    wp.config.log_level = wp.LOG_ERROR  # no banner among the progress bars
    return list(wp.get_cuda_devices())


def is_compiled(module: str, arch: int) -> bool:
    """Whether Warp's cache holds a module, one of THREADS, compiled for a compute capability, such as 90."""
    importlib.import_module(module)
    name = wp.get_module(module).get_module_identifier(THREADS[module])
    return any(Path(wp.config.kernel_cache_dir, name).glob(f"{name}.sm{arch}*"))


def compile_kernels(module: str) -> None:
    """Compile a module, one of THREADS, for the first GPU that this process sees."""
    importlib.import_module(module)
    wp.force_load(find_gpu(), [wp.get_module(module)], THREADS[module])
