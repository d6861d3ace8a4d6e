"""Exceptions from strict types for functions of two libraries, which mix them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import optax
import pytest


@contextmanager
def promotion_of_libraries() -> Iterator[None]:
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
