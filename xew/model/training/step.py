"""One training step, compiled for the mesh: noise, prediction, loss, gradients, update.

Parameters are float32. Those of linear layers are rounded to the network's dtype (mixed precision) once a step, before they are
gathered along `fsdp`, so traffic and gradients have that dtype too.
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
from jax.sharding import AbstractMesh, Mesh

from xew.model.codecs.contract import Codec
from xew.model.devices.sharding import gather_parameters, place_batch, place_shapes
from xew.model.diffusion.flow_matching import (
    TrainingPair,
    motion_weights,
    put_first,
    sample_losses,
    training_pair,
)
from xew.model.network.dit import WorldModel, cast_params, network_graph, network_shapes
from xew.model.network.lora import apply_lora, init_lora
from xew.model.runs.checkpoint import TrainState
from xew.model.settings.optimizer import average_decay
from xew.model.settings.parts import TrainSpec
from xew.model.training.data import Batch

HISTORY_KEY = 7
"""Constant folded into a sample's key for the noise of its earlier frames."""


class StepResult(NamedTuple):
    """Results of one training step, the same on every process."""

    losses: Array
    """[b k], for each chunk of each sample."""
    sigma: Array
    """[b k], noise levels."""
    weights: Array
    """[b k], each chunk's weight in its sample's loss: 1, a half, or 0 past the episode's end."""
    gradient_norm: Array
    """Global norm before clipping."""
    finite: Array
    """Whether the losses, the gradients and the new parameters are all finite."""


class Samples(NamedTuple):
    """Samples of a batch, on the leading axis of every leaf."""

    batch: Batch
    weights: Array
    """[b k], see `StepResult.weights`."""
    keys: Array
    """[b] random keys, one for each sample."""


@dataclass(frozen=True)
class Trainer:
    """Trains a network on a mesh.

    The noise depends only on the seed, the step and the position in the batch, so a resumed run repeats it.
    """

    spec: TrainSpec
    mesh: Any
    """Mesh of the devices; abstract if only shapes are needed."""
    graph: nnx.GraphDef
    shapes: TrainState
    """Shapes, types and shardings of the state."""
    codec: Codec | None = None
    """Codec of the first chunk's prediction if `train.chunks` is 2."""

    @property
    def network_shapes(self) -> Any:
        """Shapes, types and shardings of the network's parameters, with LoRA the frozen ones."""
        return self.shapes.params if self.shapes.base is None else self.shapes.base

    def init_state(self, start: Any = None) -> TrainState:
        """Make the state of step 0 from parameters on the mesh, which are donated, or from random ones."""
        with jax.set_mesh(self.mesh):
            return self._compiled_init(start)

    def random_network(self) -> tuple[nnx.GraphDef, Any]:
        """The network's structure and its initial random parameters on the mesh."""
        network = self.spec.network
        init = jax.jit(lambda: nnx.state(WorldModel(network), nnx.Param), out_shardings=list_shardings(self.network_shapes))
        return self.graph, init()

    def average_params(self, state: TrainState) -> Any:
        """The network's parameters for inference: the moving average if there is one."""
        with jax.set_mesh(self.mesh):
            return jax.jit(apply_lora)(state.base, state.params if state.ema is None else state.ema)

    def place(self, batch: Batch) -> Batch:
        """Place this process's samples on the mesh as its part of the batch."""
        return place_batch(batch, self.mesh)

    def step(self, state: TrainState, batch: Batch) -> tuple[TrainState, StepResult]:
        """Take a step with a batch on the mesh. The given state is donated."""
        with jax.set_mesh(self.mesh):
            return self._compiled_step(state, batch, self._codec_copies)

    @functools.cached_property
    def _compiled_init(self) -> Callable[[Any], TrainState]:
        return jax.jit(lambda start: _init(self.spec, start), out_shardings=list_shardings(self.shapes), donate_argnums=0)

    @functools.cached_property
    def _compiled_step(self) -> Any:
        shardings = (list_shardings(self.shapes), self.shapes.step.sharding)
        return jax.jit(self._step, donate_argnums=0, out_shardings=shardings)

    @functools.cached_property
    def _codec_copies(self) -> Codec | None:
        """The codec on every device if the step needs it."""
        if self.codec is None or self.spec.settings.chunks == 1:
            return None
        return jax.device_put(jax.tree.map(np.asarray, self.codec), self.shapes.step.sharding)

    def _step(self, state: TrainState, batch: Batch, codec: Codec | None) -> tuple[TrainState, StepResult]:
        settings = self.spec.settings
        key = jax.random.fold_in(jax.random.key(settings.seed), state.step)
        batch = as_float32(batch)
        samples = Samples(batch, chunk_weights(batch), jax.random.split(key, len(batch.latents)))
        params, vjp_fn = jax.vjp(
            lambda learned: self._keep_sharded(cast_params(self.graph, apply_lora(state.base, learned))), state.params
        )
        gradients, losses, sigma = self.gradients(params, samples, codec)
        (gradients,) = vjp_fn(jax.tree.map(lambda total, like: total.astype(like.dtype), gradients, params))
        updates, moments = self.spec.optimizer.update(gradients, state.optimizer, state.params)
        learned = optax.apply_updates(state.params, updates)
        ema = None if state.ema is None else optax.incremental_update(learned, state.ema, 1 - average_decay(settings))
        norm = optax.tree.norm(gradients)
        finite = jnp.isfinite(norm) & jnp.isfinite(optax.tree.norm(learned)) & jnp.isfinite(losses).all()
        result = StepResult(losses, sigma, samples.weights, norm, finite)
        return TrainState(state.step + 1, learned, moments, ema, state.base), result

    def _keep_sharded(self, tree: Any) -> Any:
        """Constrain a tree of parameters or gradients to its sharding along fsdp, or the compiler may gather it too soon."""
        leaves, structure = jax.tree.flatten(tree)
        shardings = jax.tree.leaves(list_shardings(self.network_shapes))
        constrained = [jax.lax.with_sharding_constraint(*pair) for pair in zip(leaves, shardings, strict=True)]
        return jax.tree.unflatten(structure, constrained)

    def gradients(self, params: Any, samples: Samples, codec: Codec | None) -> tuple[Any, Array, Array]:
        """Gradients of the mean loss over samples, and the chunks' losses and noise levels [b k].

        Sums over parts of the batch (`train.accumulate`) and over chunks are in float32.
        """
        size, parts = len(samples.keys), self.spec.settings.accumulate
        if parts == 1:
            return self._part_gradients(params, samples, codec, size)

        def add(total: Any, part: Samples) -> tuple[Any, tuple[Array, Array]]:
            gradients, losses, sigma = self._part_gradients(params, part, codec, size)
            return self._keep_sharded(_sum(total, gradients)), (losses, sigma)

        zeros = self._keep_sharded(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, jnp.float32), params))
        cut = jax.tree.map(lambda leaf: cut_samples(leaf, parts), samples)
        gradients, (losses, sigma) = jax.lax.scan(add, zeros, cut)
        return gradients, join_samples(losses), join_samples(sigma)

    def _part_gradients(self, params: Any, samples: Samples, codec: Codec | None, size: int) -> tuple[Any, Array, Array]:
        """Gradients, losses and noise levels of one part of a batch of `size` samples."""
        settings = self.spec.settings
        gradients, losses, sigmas, chunk = None, [], [], samples.batch
        for number in range(samples.weights.shape[1]):
            keys = jax.vmap(jax.random.fold_in, (0, None))(samples.keys, number)
            pair = sample_pairs(keys, chunk.latents, settings.shift)
            chunk = add_history_noise(keys, chunk, settings.history_noise)
            of_chunk, loss, predicted = self._chunk_gradients(params, chunk, pair, samples.weights[:, number] / size)
            gradients = of_chunk if gradients is None else self._keep_sharded(_sum(gradients, of_chunk))
            losses.append(loss)
            sigmas.append(pair.sigma)
            if chunk.following is not None:
                assert codec is not None, "two chunks need the codec"
                clean = estimate_clean(chunk.latents, pair, predicted)
                latents = put_first(chunk.following.latents, codec.next_reference(clean))
                chunk = replace(chunk.following, latents=latents)
        return gradients, jnp.stack(losses, axis=1), jnp.stack(sigmas, axis=1)

    def _chunk_gradients(self, params: Any, chunk: Batch, pair: TrainingPair, shares: Array) -> tuple[Any, Array, Array]:
        """Gradients, losses [b] and prediction of one chunk; `shares` [b] are the samples' weights in the loss."""
        strength = self.spec.settings.motion_loss_weight
        weights = motion_weights(chunk.latents, strength) if strength else None

        def loss(params: Any) -> tuple[Array, tuple[Array, Array]]:
            predicted = nnx.merge(self.graph, gather_parameters(params))(pair.noisy, chunk.conditions, pair.sigma, chunk.text)
            losses = sample_losses(predicted, pair, chunk.valid, weights)
            return (shares * losses).sum(), (losses, predicted)

        gradients, (losses, predicted) = jax.grad(loss, has_aux=True)(params)
        return self._keep_sharded(gradients), losses, predicted


def make_trainer(spec: TrainSpec, mesh: Mesh | AbstractMesh, codec: Codec | None = None) -> Trainer:
    """Make the trainer of a network and its optimizer on a mesh, from shapes alone."""
    shapes = jax.eval_shape(lambda params: _init(spec, params), network_shapes(spec.network))
    return Trainer(spec, mesh, network_graph(spec.network), place_shapes(shapes, mesh), codec)


def _init(spec: TrainSpec, start: Any) -> TrainState:
    """Make the state of step 0 from the given or random parameters."""
    params = nnx.state(WorldModel(spec.network), nnx.Param) if start is None else start
    base, learned = None, params
    if spec.lora_rank:
        base, learned = params, init_lora(params, spec.lora_rank, jax.random.key(spec.settings.seed))
    ema = jax.tree.map(jnp.copy, learned) if spec.settings.ema else None
    return TrainState(jnp.int32(0), learned, spec.optimizer.init(learned), ema, base)


def list_shardings(shapes: Any) -> Any:
    """The shardings of a tree of shapes."""
    return jax.tree.map(lambda leaf: leaf.sharding, shapes)


def sample_pairs(keys: Array, latents: Array, shift: float) -> TrainingPair:
    """The `training_pair` of each sample of latents [b t h w c], with its own key [b]."""
    pairs = jax.vmap(lambda key, sample: training_pair(key, sample[None], shift))(keys, latents)
    return jax.tree.map(lambda leaf: leaf[:, 0], pairs)


def add_history_noise(keys: Array, chunk: Batch, strength: float) -> Batch:
    """Add noise to the earlier frames [b t h w c] of a chunk if it has any, because a rollout's are predictions."""
    if "history" not in chunk.conditions or not strength:
        return chunk
    history = chunk.conditions["history"]
    keys = jax.vmap(jax.random.fold_in, (0, None))(keys, HISTORY_KEY)
    noise = jax.vmap(lambda key, sample: jax.random.normal(key, sample.shape, jnp.float32))(keys, history)
    return replace(chunk, conditions={**chunk.conditions, "history": history + strength * noise})


def estimate_clean(latents: Array, pair: TrainingPair, predicted: Array) -> Array:
    """Estimate the clean latents [b t h w c] in one step from a predicted velocity [b t h w c]; frame 0 is the given one."""
    clean = pair.noisy - pair.sigma[:, None, None, None, None] * predicted
    return put_first(clean, latents[:, :1])


def as_float32(batch: Batch) -> Batch:
    """The batch with its latents, stored as float16, as float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float16 else leaf, batch)


def chunk_weights(batch: Batch) -> Array:
    """Each chunk's weight [b k] in its sample's loss: equal over chunks with valid frames after the first."""
    if batch.following is None:
        return jnp.ones((len(batch.latents), 1), jnp.float32)
    later = batch.following.valid[:, 1:].any(axis=1).astype(jnp.float32)
    valid = jnp.stack([jnp.ones(len(later)), later], axis=1)
    return valid / valid.sum(axis=1, keepdims=True)


def cut_samples(leaf: Array, parts: int) -> Array:
    """Cut [b ...] into [parts b/parts ...]: part i has samples i, i + parts, …, so samples stay on their devices."""
    return leaf.reshape(-1, parts, *leaf.shape[1:]).swapaxes(0, 1)


def join_samples(leaf: Array) -> Array:
    """Join [parts b/parts ...] to [b ...]: the inverse of `cut_samples`."""
    return leaf.swapaxes(0, 1).reshape(-1, *leaf.shape[2:])


def _sum(total: Any, more: Any) -> Any:
    return jax.tree.map(lambda a, b: a.astype(jnp.float32) + b.astype(jnp.float32), total, more)
