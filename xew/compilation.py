"""Resources that processes share through JAX: compiled programs and a GPU's memory. JAX is imported on first use."""

import os

from xew.files import cache_folder

LEAST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
"""Environment variable with the shortest compile time from which JAX caches a program."""


def keep_compiled_programs() -> None:
    """Cache all compiled programs in the user's cache folder, unless JAX is configured otherwise.

    JAX by default caches only programs that compile for a second or more.
    """
    import jax

    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(cache_folder("jax")))
        if LEAST not in os.environ:
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def take_memory_as_needed() -> None:
    """Disable JAX's preallocation of GPU memory, unless the user has set it; call this before the first computation.

    Commands need it that share a GPU with Warp or with their own worker processes.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
