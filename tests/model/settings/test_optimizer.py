"""Optimizers: what each keeps of a network's parameters, and how it moves them."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from xew.model.settings.checks import LONGEST_AVERAGE
from xew.model.settings.optimizer import ADAM_SHARE, RMS_OF_ADAM, average_decay, find_matrices, make_optimizer
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
    settings = TrainSettings(steps=2)
    kept = jax.tree.leaves(make_optimizer(settings).init(params))
    shapes = sorted(leaf.shape for leaf in kept)
    assert shapes.count((2, 8, 32)) == 1, "Muon has one moment"
    assert shapes.count((8, 16)) == shapes.count((2, 6, 8)) == 2, "AdamW has two"


@pytest.mark.parametrize("mu_dtype", ["float32", "bfloat16"])
def test_updates_of_muon_are_near_orthogonal_and_as_large_as_those_of_adamw(params: dict, mu_dtype: Any) -> None:
    settings = TrainSettings(steps=2, warmup_steps=0, learning_rate=1.0, mu_dtype=mu_dtype)
    optimizer = make_optimizer(settings)
    updates, _ = optimizer.update(params, optimizer.init(params), jax.tree.map(jnp.zeros_like, params))
    for update in np.asarray(updates["blocks"]["first"]["kernel"], np.float32):
        values = np.linalg.svd(update, compute_uv=False)
        assert values.min() > 0.5 * values.max()
        assert np.sqrt(np.square(update).mean()) == pytest.approx(RMS_OF_ADAM, rel=0.3)


def test_a_burst_of_gradients_makes_no_large_steps_beside_muon(params: dict) -> None:
    """Gradients ten times as large as 1,000 before move AdamW's parameters by little more than their learning rate."""
    settings = TrainSettings(steps=2000, warmup_steps=0, learning_rate=1.0, decay_to=1, mu_dtype="float32")
    optimizer, gradient = make_optimizer(settings), jax.tree.map(lambda leaf: 1e-3 * jnp.ones_like(leaf), params)
    step = jax.jit(lambda gradient, state: optimizer.update(gradient, state, jax.tree.map(jnp.zeros_like, params)))
    state = optimizer.init(params)
    for _ in range(1000):
        update, state = step(gradient, state)
    assert np.asarray(update["head"]["kernel"]) == pytest.approx(-ADAM_SHARE, rel=1e-3)
    moved = []
    for _ in range(20):
        update, state = step(jax.tree.map(lambda leaf: 10 * leaf, gradient), state)
        moved.append(float(jnp.abs(update["head"]["kernel"]).max()))
    assert max(moved) < 1.3 * ADAM_SHARE


def test_muon_computes_in_the_type_of_its_moments(params: dict) -> None:
    """Its products are in bfloat16 where that is asked for; the updates stay near those of float32."""
    settings = TrainSettings(steps=2, warmup_steps=0, learning_rate=1.0)
    exact, rounded = (make_optimizer(replace(settings, mu_dtype=dtype)) for dtype in ("float32", "bfloat16"))
    kept = rounded.init(params)
    program = str(jax.make_jaxpr(rounded.update)(params, kept, params))
    assert "bf16[2,8,8] = dot_general" in program and "f32[2,8,8] = dot_general" not in program
    updates = [one.update(params, one.init(params), params)[0]["blocks"]["first"]["kernel"] for one in (exact, rounded)]
    true, found = (np.asarray(update, np.float32) for update in updates)
    assert 0 < np.linalg.norm(found - true) < 0.1 * np.linalg.norm(true)


@pytest.mark.parametrize("steps", [4, 200, 7500])
@pytest.mark.parametrize("ema", [0.1, LONGEST_AVERAGE])
def test_an_average_forgets_the_random_start(steps: int, ema: float) -> None:
    """However short the run: what is left of the start at its end is at most exp(-1 / ema)."""
    assert average_decay(TrainSettings(steps=steps, ema=ema)) ** steps <= np.exp(-1 / ema) < 0.02


def test_an_average_reaches_over_its_fraction_of_the_run() -> None:
    assert average_decay(TrainSettings(steps=7500, ema=0.1)) == pytest.approx(1 - 1 / 750)
