"""What the tests of the model room share: exceptions from strict types for two libraries, and programs of alike trainings."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests.promotion import promotion_of_libraries
from xew.model import train
from xew.model.settings.parts import TrainSpec
from xew.model.training import step
from xew.model.training.step import Trainer


@pytest.fixture(scope="session", autouse=True)
def libraries_may_promote() -> Iterator[None]:
    with promotion_of_libraries():
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
