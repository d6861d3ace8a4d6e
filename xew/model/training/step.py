"""One step of training: noise, prediction, loss, gradients, update; compiled for the mesh.

Reads  `TrainState`, `Batch`
Writes the next `TrainState`, `StepResult`
The optimizer is made in settings/optimizer.py, the noise in diffusion/flow_matching.py.

The parameters are float32. The linear layers' are rounded to the network's dtype once a step, before they are gathered
along `fsdp`, so that the traffic and the gradients have that dtype too; the numbers are the same as if every layer
rounded its own.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax import Array
from jax.sharding import Mesh

from xew.model.codecs.contract import Codec
from xew.model.devices.sharding import gather_parameters, place_shapes
from xew.model.diffusion.flow_matching import (
    TrainingPair,
    moving_weights,
    put_first,
    sample_losses,
    training_pair,
)
from xew.model.network.dit import cast_params
from xew.model.network.lora import apply_lora, init_lora
from xew.model.runs.checkpoint import TrainState
from xew.model.settings.parts import Learning
from xew.model.training.data import Batch

HISTORY_KEY = 7
"""Folded into a sample's key for the noise of its earlier frames, which `training_pair` does not know of."""


class StepResult(NamedTuple):
    """What one training step reports; small, and the same on every process."""

    losses: Array
    """[b k], one for each chunk of each sample."""
    sigma: Array
    """[b k], their noise levels."""
    weights: Array
    """[b k], each chunk's share in its sample's loss: 1, a half, or 0 where the episode has ended before."""
    gradient_norm: Array
    """Global norm before clipping."""
    finite: Array
    """Whether the losses, the gradients and the new parameters are all finite."""


@dataclass(frozen=True)
class Learner:
    """A network and its optimizer on a mesh: the structure, and where each part of the state lies."""

    learning: Learning
    mesh: Mesh
    graph: nnx.GraphDef
    shapes: TrainState
    """Shapes, types and shardings of the state; its step has a copy on every device."""

    @property
    def network_shapes(self) -> Any:
        """Shapes, types and shardings of the network's parameters, which with LoRA are not those that are learned."""
        return self.shapes.params if self.shapes.base is None else self.shapes.base

    def init_state(self, start: Any = None) -> TrainState:
        """Make the state of step 0, on the devices where each part of it lies.

        Args:
            start: parameters to begin with, placed on the mesh; random where left out. They are given up to the state.
        """
        with jax.set_mesh(self.mesh):
            return self._compiled_init(start)

    @functools.cached_property
    def _compiled_init(self) -> Callable[[Any], TrainState]:
        return jax.jit(lambda start: _init(self.learning, start), out_shardings=list_shardings(self.shapes), donate_argnums=0)

    def random_network(self) -> tuple[nnx.GraphDef, Any]:
        """The network's structure and its parameters at their random start, made where they lie on the mesh."""
        network = self.learning.network
        init = jax.jit(lambda: nnx.state(network.create(), nnx.Param), out_shardings=list_shardings(self.network_shapes))
        return self.graph, init()

    def average_params(self, state: TrainState) -> Any:
        """The network's parameters for inference: the moving average where one is kept."""
        with jax.set_mesh(self.mesh):
            return jax.jit(apply_lora)(state.base, state.params if state.ema is None else state.ema)

    def compile_step(self, codec: Codec | None = None) -> "TrainStep":
        """The compiled step; its noise depends on the seed, the step and the place in the batch only.

        A resumed run therefore repeats it.

        Args:
            codec: needed where `train.chunks` is 2, to decode and encode the first chunk's prediction.
        """
        settings, graph, optimizer = self.learning.settings, self.graph, self.learning.optimizer
        places = list_shardings(self.network_shapes)
        objective = Objective(graph, places, settings.shift, settings.accumulate, settings.history_noise, settings.moving)

        def step(state: TrainState, batch: Batch, codec: Codec | None) -> tuple[TrainState, StepResult]:
            key = jax.random.fold_in(jax.random.key(settings.seed), state.step)
            samples = Samples(batch, chunk_weights(batch), jax.random.split(key, len(batch.latents)))
            params, back = jax.vjp(
                lambda learned: objective.place(cast_params(graph, apply_lora(state.base, learned))), state.params
            )
            gradients, losses, sigma = objective.gradients(params, samples, codec)
            (gradients,) = back(jax.tree.map(lambda total, like: total.astype(like.dtype), gradients, params))
            updates, moments = optimizer.update(gradients, state.optimizer, state.params)
            learned = optax.apply_updates(state.params, updates)
            ema = None if state.ema is None else optax.incremental_update(learned, state.ema, 1 - settings.ema_decay)
            norm = optax.tree.norm(gradients)
            finite = jnp.isfinite(norm) & jnp.isfinite(optax.tree.norm(learned)) & jnp.isfinite(losses).all()
            result = StepResult(losses, sigma, samples.weights, norm, finite)
            return TrainState(state.step + 1, learned, moments, ema, state.base), result

        everywhere = self.shapes.step.sharding
        jitted = jax.jit(step, donate_argnums=0, out_shardings=(list_shardings(self.shapes), everywhere))
        copies = jax.device_put(jax.tree.map(np.asarray, codec), everywhere) if settings.chunks == 2 else None
        return TrainStep(jitted, self.mesh, copies)


def make_learner(learning: Learning, mesh: Mesh) -> Learner:
    """Lay a network and its optimizer out on a mesh, without computing anything."""
    graph, shapes = abstract_state(learning)
    return Learner(learning, mesh, graph, place_shapes(shapes, mesh))


def abstract_state(learning: Learning) -> tuple[nnx.GraphDef, TrainState]:
    """The network's structure, and the shapes and types of the state of step 0, without computing anything."""
    network = learning.network
    return network.structure, jax.eval_shape(lambda params: _init(learning, params), network.shapes)


def _init(learning: Learning, start: Any) -> TrainState:
    """Make the state of step 0 from loaded parameters, or from random ones where there are none."""
    params = nnx.state(learning.network.create(), nnx.Param) if start is None else start
    base, learned, settings = None, params, learning.settings
    if learning.lora_rank:
        base = params
        learned = init_lora(params, learning.lora_rank, jax.random.key(settings.seed))
    ema = jax.tree.map(jnp.copy, learned) if settings.ema_decay else None
    return TrainState(jnp.int32(0), learned, learning.optimizer.init(learned), ema, base)


def list_shardings(shapes: Any) -> Any:
    """The shardings of shapes that have their places, in the same tree."""
    return jax.tree.map(lambda leaf: leaf.sharding, shapes)


@dataclass(frozen=True)
class TrainStep:
    """The compiled step: (state, batch on the mesh) -> (next state, result). The given state is used up."""

    jitted: Any
    mesh: Mesh
    codec: Codec | None

    def __call__(self, state: TrainState, batch: Batch) -> tuple[TrainState, StepResult]:
        with jax.set_mesh(self.mesh):
            return self.jitted(state, batch, self.codec)

    def lower(self, state: TrainState, batch: Batch) -> jax.stages.Lowered:
        """The program for arrays or for their shapes and shardings, to compile without running and to look at its memory."""
        with jax.set_mesh(self.mesh):
            return self.jitted.lower(state, batch, self.codec)


class Samples(NamedTuple):
    """Some samples of a batch: every leaf has them as its leading axis."""

    batch: Batch
    weights: Array
    """[b k], see `StepResult.weights`."""
    keys: Array
    """[b] random keys, so that a sample's noise does not depend on how the batch is cut."""


@dataclass(frozen=True)
class Objective:
    """The loss of a batch, and its gradients part by part."""

    graph: nnx.GraphDef
    places: Any
    """Shardings of the network's parameters, in their tree."""
    shift: float
    parts: int
    """Number of parts of the batch that are computed one after another."""
    history_noise: float = 0.0
    """Standard deviation of the noise on earlier frames' latents."""
    moving: float = 0.0
    """Additional weight in the loss of what moves, at most."""

    def place(self, tree: Any) -> Any:
        """Keep a tree like that of the parameters cut along fsdp as they are: the compiler might gather it too soon."""
        leaves, structure = jax.tree.flatten(tree)
        kept = [jax.lax.with_sharding_constraint(*pair) for pair in zip(leaves, jax.tree.leaves(self.places), strict=True)]
        return jax.tree.unflatten(structure, kept)

    def gradients(self, params: Any, samples: Samples, codec: Codec | None) -> tuple[Any, Array, Array]:
        """Gradients of the mean loss over samples, and the chunks' losses and noise levels [b k].

        A sample's loss is the mean over its chunks. Sums over parts and over chunks are in float32.
        """
        size = len(samples.keys)
        if self.parts == 1:
            return self._part_gradients(params, samples, codec, size)

        def add(total: Any, part: Samples) -> tuple[Any, tuple[Array, Array]]:
            gradients, losses, sigma = self._part_gradients(params, part, codec, size)
            return self.place(_sum(total, gradients)), (losses, sigma)

        zeros = self.place(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, jnp.float32), params))
        cut = jax.tree.map(lambda leaf: cut_samples(leaf, self.parts), samples)
        gradients, (losses, sigma) = jax.lax.scan(add, zeros, cut)
        return gradients, join_samples(losses), join_samples(sigma)

    def _part_gradients(self, params: Any, samples: Samples, codec: Codec | None, size: int) -> tuple[Any, Array, Array]:
        """Gradients, losses and noise levels of one part; `size` is the number of samples of the whole batch."""
        gradients, losses, sigmas, chunk = None, [], [], samples.batch
        for number in range(samples.weights.shape[1]):
            keys = jax.vmap(jax.random.fold_in, (0, None))(samples.keys, number)
            pair = sample_pairs(keys, chunk.latents, self.shift)
            chunk = add_history_noise(keys, chunk, self.history_noise)
            own, loss, predicted = self._chunk_gradients(params, chunk, pair, samples.weights[:, number] / size)
            gradients = own if gradients is None else self.place(_sum(gradients, own))
            losses.append(loss)
            sigmas.append(pair.sigma)
            if chunk.following is not None:
                assert codec is not None, "two chunks need the codec"
                clean = estimate_clean(chunk.latents, pair, predicted)
                latents = put_first(chunk.following.latents, codec.next_reference(clean))
                chunk = replace(chunk.following, latents=latents)
        return gradients, jnp.stack(losses, axis=1), jnp.stack(sigmas, axis=1)

    def _chunk_gradients(self, params: Any, chunk: Batch, pair: TrainingPair, shares: Array) -> tuple[Any, Array, Array]:
        """Gradients, losses [b] and prediction of one chunk, whose samples have these shares in the loss [b]."""

        weights = moving_weights(chunk.latents, self.moving) if self.moving else None

        def loss(params: Any) -> tuple[Array, tuple[Array, Array]]:
            predicted = nnx.merge(self.graph, gather_parameters(params))(pair.noisy, chunk.conditions, pair.sigma, chunk.text)
            losses = sample_losses(predicted, pair, chunk.valid, weights)
            return (shares * losses).sum(), (losses, predicted)

        gradients, (losses, predicted) = jax.grad(loss, has_aux=True)(params)
        return self.place(gradients), losses, predicted


def sample_pairs(keys: Array, latents: Array, shift: float) -> TrainingPair:
    """Make the `training_pair` of each sample of latents [b t h w c], with its own key [b]."""
    pairs = jax.vmap(lambda key, sample: training_pair(key, sample[None], shift))(keys, latents)
    return jax.tree.map(lambda leaf: leaf[:, 0], pairs)


def add_history_noise(keys: Array, chunk: Batch, strength: float) -> Batch:
    """Add noise to the earlier frames [b t h w c] of a chunk, if it has any: a rollout's are its own predictions."""
    if "history" not in chunk.conditions or not strength:
        return chunk
    history = chunk.conditions["history"]
    keys = jax.vmap(jax.random.fold_in, (0, None))(keys, HISTORY_KEY)
    noise = jax.vmap(lambda key, sample: jax.random.normal(key, sample.shape, jnp.float32))(keys, history)
    return replace(chunk, conditions={**chunk.conditions, "history": history + strength * noise})


def estimate_clean(latents: Array, pair: TrainingPair, predicted: Array) -> Array:
    """Estimate the clean latents [b t h w c] in one step from a predicted velocity [b t h w c].

    Frame 0 of the estimate is the given one [b t h w c].
    """
    clean = pair.noisy - pair.sigma[:, None, None, None, None] * predicted
    return put_first(clean, latents[:, :1])


def chunk_weights(batch: Batch) -> Array:
    """Each chunk's share [b k] in its sample's loss: equal over those that show the episode beyond their first frame."""
    if batch.following is None:
        return jnp.ones((len(batch.latents), 1), jnp.float32)
    later = batch.following.valid[:, 1:].any(axis=1).astype(jnp.float32)
    valid = jnp.stack([jnp.ones(len(later)), later], axis=1)
    return valid / valid.sum(axis=1, keepdims=True)


def cut_samples(leaf: Array, parts: int) -> Array:
    """Cut [b ...] into [parts b/parts ...]: part i has samples i, i + parts, …, so that every device keeps its own."""
    return leaf.reshape(-1, parts, *leaf.shape[1:]).swapaxes(0, 1)


def join_samples(leaf: Array) -> Array:
    """Join [parts b/parts ...] to [b ...]: the inverse of `cut_samples`."""
    return leaf.swapaxes(0, 1).reshape(-1, *leaf.shape[2:])


def _sum(total: Any, more: Any) -> Any:
    return jax.tree.map(lambda a, b: a.astype(jnp.float32) + b.astype(jnp.float32), total, more)
