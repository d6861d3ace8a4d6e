"""What the tests of the model room share: exceptions from strict types for two libraries, and programs of alike trainings."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import optax
import pytest

from xew.model import train
from xew.model.settings.parts import TrainSpec
from xew.model.training import step
from xew.model.training.step import Trainer


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


@pytest.fixture(scope="session", autouse=True)
def alike_trainings_share_programs() -> Iterator[None]:
    """Trainings of the same settings trace and compile their step once in this process, which is most of a tiny one's time.

    That a process of its own makes the same of a run, tests of many devices and of killed runs see.
    """
    trainers: dict[Any, tuple[Trainer, Any]] = {}
    make_new = step.make_trainer

    def make_trainer(spec: TrainSpec, mesh: Any, codec: Any = None) -> Trainer:
        of_codec = None if codec is None else getattr(codec, "hash", id(codec))
        key = (spec.network, spec.settings, spec.lora_rank, mesh, of_codec)
        if key not in trainers:
            trainers[key] = make_new(spec, mesh, codec), codec  # with the codec, so that no other gets its id
        return trainers[key][0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "make_trainer", make_trainer)
        yield


def loosely(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function with JAX's default promotion of types."""

    def call(*arguments: Any, **named: Any) -> Any:
        with jax.numpy_dtype_promotion("standard"):
            return function(*arguments, **named)

    return call
