"""What the tests of the model room share: exceptions from strict types for two libraries, and quick compiling."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import optax
import pytest


@pytest.fixture(scope="session", autouse=True)
def libraries_may_promote() -> Iterator[None]:
    """What strict types forbid but libraries do.

    Optax raises float decays to the power of its int32 count of steps (bias correction); JAX's attention adds up bfloat16
    products in float32.
    """
    chain = optax.chain

    def loose_chain(*transformations: optax.GradientTransformation) -> optax.GradientTransformation:
        chained = chain(*transformations)
        return optax.GradientTransformation(chained.init, loosely(chained.update))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(optax, "chain", loose_chain)
        patch.setattr(jax.nn, "dot_product_attention", loosely(jax.nn.dot_product_attention))
        yield


def loosely(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function with JAX's default promotion of types."""

    def call(*arguments: Any, **named: Any) -> Any:
        with jax.numpy_dtype_promotion("standard"):
            return function(*arguments, **named)

    return call


@pytest.fixture(scope="module")
def quick_compile() -> Iterator[None]:
    """Leave out what makes programs fast, for modules most of whose time is compiling.

    Programs of the two kinds may differ in the last bit, and JAX does not tell them apart in memory.
    """
    jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()
