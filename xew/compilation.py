"""What processes share of JAX: compiled programs and a GPU's memory. JAX is imported only where this is asked for."""

import os

from xew.files import cache_folder

LEAST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
"""Environment variable by which a user says from which compiling time on JAX keeps a program."""


def keep_compiled_programs() -> None:
    """Keep compiled programs between runs in the user's cache folder, unless JAX was told otherwise.

    All of them: JAX itself keeps those that compile for a second and more, and a process that grades has eight shorter ones,
    which take it 2.5 s on a CPU.
    """
    import jax

    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(cache_folder("jax")))
        if LEAST not in os.environ:
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


ALLOCATOR = "XLA_PYTHON_CLIENT_ALLOCATOR"
"""Environment variable by which JAX is told how to take a GPU's memory."""
GIVING_BACK = "platform"
"""Value of ALLOCATOR with which JAX gives memory back after each use, for others on the same GPU; it takes longer."""


def take_memory_as_needed() -> None:
    """Have JAX take a GPU's memory as it needs it and not three quarters at once, unless it was told otherwise.

    It is for commands that share a GPU with Warp or with processes of their own, before JAX's first computation.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
