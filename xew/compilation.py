"""Compiled JAX programs, kept between processes; JAX is imported only where this is asked for."""

from xew.files import cache_folder


def keep_compiled_programs() -> None:
    """Keep compiled programs between runs in the user's cache folder, unless JAX was told otherwise."""
    import jax

    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(cache_folder("jax")))
