"""Optimizers: what each keeps of a network's parameters, and how it moves them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xew.model.settings.optimizer import RMS_OF_ADAM, find_matrices, make_optimizer
from xew.model.settings.settings import TrainSettings

SHAPES = {
    "blocks": {"first": {"kernel": (2, 8, 32), "bias": (2, 32)}, "modulation": (2, 6, 8)},
    "head": {"kernel": (8, 16)},
}


@pytest.fixture(scope="module")
def params() -> dict:
    """Random parameters [...] float32 of two stacked blocks and a head."""
    shapes, structure = jax.tree.flatten(SHAPES, is_leaf=lambda leaf: isinstance(leaf, tuple))
    keys = jax.random.split(jax.random.key(0), len(shapes))
    return jax.tree.unflatten(structure, [jax.random.normal(key, shape) for key, shape in zip(keys, shapes, strict=True)])


def test_muon_takes_the_matrices_of_blocks_and_nothing_else(params: dict) -> None:
    found = find_matrices(params)
    assert found["blocks"]["first"]["kernel"] is not None
    assert jax.tree.leaves((found["blocks"]["first"]["bias"], found["blocks"]["modulation"], found["head"])) == []
    settings = TrainSettings(batch=1, steps=2, optimizer="muon")
    kept = jax.tree.leaves(make_optimizer(settings).init(params))
    shapes = sorted(leaf.shape for leaf in kept)
    assert shapes.count((2, 8, 32)) == 1, "Muon has one moment"
    assert shapes.count((8, 16)) == shapes.count((2, 6, 8)) == 2, "AdamW has two"


def test_updates_of_muon_are_near_orthogonal_and_as_large_as_those_of_adamw(params: dict) -> None:
    settings = TrainSettings(batch=1, steps=2, optimizer="muon", learning_rate=1.0, weight_decay=0.0)
    optimizer = make_optimizer(settings)
    updates, _ = optimizer.update(params, optimizer.init(params), jax.tree.map(jnp.zeros_like, params))
    for update in updates["blocks"]["first"]["kernel"]:
        values = np.linalg.svd(update, compute_uv=False)
        assert values.min() > 0.5 * values.max()
        assert np.sqrt(np.square(update).mean()) == pytest.approx(RMS_OF_ADAM, rel=0.3)
