"""Strict session for the model room: no silent type promotion, no silent broadcasting over missing axes."""

from collections.abc import Iterator

import jax
import pytest


@pytest.fixture(autouse=True)
def strict_shapes() -> Iterator[None]:
    """Arrays of different rank never broadcast silently."""
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture
def strict_types() -> Iterator[None]:
    """No implicit conversion between types; not for tests that train, since Optax itself relies on some."""
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(scope="session", autouse=True)
def own_compile_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The session compiles equal programs once and leaves the user's cache alone."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path_factory.mktemp("jax")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture(scope="module")
def quick_compile() -> Iterator[None]:
    """For modules most of whose time is compiling: leave out what makes programs fast.

    Programs of the two kinds may differ in the last bit, and JAX does not tell them apart in memory.
    """
    jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()
