"""One step of training: noise, prediction, loss, gradients, update; compiled for the mesh.

Reads  `TrainState`, `Batch`
Writes the next `TrainState`, `StepResult`

The parameters are float32. The linear layers' are rounded to the network's dtype once a step, before they are gathered
along `fsdp`, so that the traffic and the gradients have that dtype too; the numbers are the same as if every layer
rounded its own.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax import Array
from jax.sharding import Mesh

from xew.model.codecs.codec import Codec
from xew.model.devices.sharding import gather_parameters, replicated_sharding, state_shardings
from xew.model.diffusion.flow_matching import TrainingPair, sample_losses, training_pair
from xew.model.experiment import Experiment, create_model
from xew.model.network.dit import cast_params
from xew.model.network.lora import apply_lora, init_lora
from xew.model.runs.checkpoint import TrainState
from xew.model.training.data import Batch
from xew.model.training.optimizer import make_optimizer

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


def abstract_state(experiment: Experiment) -> tuple[nnx.GraphDef, TrainState]:
    """The network's structure, and the shapes and types of the state of step 0, without computing anything."""
    graph = nnx.split(nnx.eval_shape(lambda: create_model(experiment)), nnx.Param)[0]
    return graph, jax.eval_shape(lambda: _init(experiment, None))


def _init(experiment: Experiment, start: Any) -> TrainState:
    """The state of step 0 from loaded parameters, or from random ones where there are none."""
    params = nnx.state(create_model(experiment), nnx.Param) if start is None else start
    base, learned = None, params
    if experiment.adapt.lora_rank:
        base = params
        learned = init_lora(params, experiment.adapt.lora_rank, jax.random.key(experiment.train.seed))
    ema = jax.tree.map(jnp.copy, learned) if experiment.train.ema_decay else None
    return TrainState(jnp.int32(0), learned, make_optimizer(experiment.train).init(learned), ema, base)


def init_train_state(experiment: Experiment, mesh: Mesh, start: Any = None) -> tuple[nnx.GraphDef, TrainState]:
    """The network's structure and the state of step 0, made on the devices where each part of it lies.

    Args:
        start: parameters to begin with, placed on the mesh; random where left out. They are given up to the state.
    """
    graph, shapes = abstract_state(experiment)
    init = jax.jit(lambda start: _init(experiment, start), out_shardings=state_shardings(shapes, mesh), donate_argnums=0)
    with jax.set_mesh(mesh):
        return graph, init(start)


def random_params(experiment: Experiment, mesh: Mesh) -> tuple[nnx.GraphDef, Any]:
    """The network's structure and its parameters at their random start, made where they lie on the mesh."""
    graph, shapes = nnx.split(nnx.eval_shape(lambda: create_model(experiment)), nnx.Param)
    init = jax.jit(lambda: nnx.state(create_model(experiment), nnx.Param), out_shardings=state_shardings(shapes, mesh))
    return graph, init()


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


def make_train_step(experiment: Experiment, graph: nnx.GraphDef, mesh: Mesh, codec: Codec | None = None) -> TrainStep:
    """The compiled step; its noise depends on the seed, the step and the place in the batch only, so a resumed run repeats it.

    Args:
        codec: needed where `train.chunks` is 2, to decode and encode the first chunk's prediction.
    """
    settings, optimizer = experiment.train, make_optimizer(experiment.train)
    objective = Objective(graph, mesh, settings.shift, settings.accumulate, settings.history_noise)

    def step(state: TrainState, batch: Batch, codec: Codec | None) -> tuple[TrainState, StepResult]:
        key = jax.random.fold_in(jax.random.key(settings.seed), state.step)
        rows = Rows(batch, chunk_weights(batch), jax.random.split(key, len(batch.latents)))
        params, back = jax.vjp(
            lambda learned: objective.place(cast_params(graph, apply_lora(state.base, learned))), state.params
        )
        gradients, losses, sigma = objective.gradients(params, rows, codec)
        (gradients,) = back(jax.tree.map(lambda total, like: total.astype(like.dtype), gradients, params))
        updates, moments = optimizer.update(gradients, state.optimizer, state.params)
        learned = optax.apply_updates(state.params, updates)
        ema = None if state.ema is None else optax.incremental_update(learned, state.ema, 1 - settings.ema_decay)
        norm = optax.tree.norm(gradients)
        finite = jnp.isfinite(norm) & jnp.isfinite(optax.tree.norm(learned)) & jnp.isfinite(losses).all()
        result = StepResult(losses, sigma, rows.weights, norm, finite)
        return TrainState(state.step + 1, learned, moments, ema, state.base), result

    shardings = state_shardings(abstract_state(experiment)[1], mesh)
    jitted = jax.jit(step, donate_argnums=0, out_shardings=(shardings, replicated_sharding(mesh)))
    everywhere = jax.device_put(jax.tree.map(np.asarray, codec), replicated_sharding(mesh)) if settings.chunks == 2 else None
    return TrainStep(jitted, mesh, everywhere)


class Rows(NamedTuple):
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
    mesh: Mesh
    shift: float
    parts: int
    """How many parts of the batch are computed one after another."""
    history_noise: float = 0.0
    """Of earlier frames' latents."""

    def place(self, tree: Any) -> Any:
        """Keep a tree in the shape of the parameters cut along fsdp as they are: the compiler might gather it too soon."""
        return jax.lax.with_sharding_constraint(tree, state_shardings(tree, self.mesh))

    def gradients(self, params: Any, rows: Rows, codec: Codec | None) -> tuple[Any, Array, Array]:
        """Gradients of the mean loss over samples, and the chunks' losses and noise levels [b k].

        A sample's loss is the mean over its chunks. Sums over parts and over chunks are in float32.
        """
        size = len(rows.keys)
        if self.parts == 1:
            return self._of_part(params, rows, codec, size)

        def add(total: Any, part: Rows) -> tuple[Any, tuple[Array, Array]]:
            gradients, losses, sigma = self._of_part(params, part, codec, size)
            return self.place(_sum(total, gradients)), (losses, sigma)

        zeros = self.place(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, jnp.float32), params))
        cut = jax.tree.map(lambda leaf: cut_rows(leaf, self.parts), rows)
        gradients, (losses, sigma) = jax.lax.scan(add, zeros, cut)
        return gradients, join_rows(losses), join_rows(sigma)

    def _of_part(self, params: Any, rows: Rows, codec: Codec | None, size: int) -> tuple[Any, Array, Array]:
        """One part; `size` is the number of samples of the whole batch."""
        gradients, losses, sigmas, chunk = None, [], [], rows.batch
        for number in range(rows.weights.shape[1]):
            keys = jax.vmap(jax.random.fold_in, (0, None))(rows.keys, number)
            pair = sample_pairs(keys, chunk.latents, self.shift)
            chunk = with_noisy_history(keys, chunk, self.history_noise)
            of_chunk, loss, predicted = self._of_chunk(params, chunk, pair, rows.weights[:, number] / size)
            gradients = of_chunk if gradients is None else self.place(_sum(gradients, of_chunk))
            losses.append(loss)
            sigmas.append(pair.sigma)
            if chunk.following is not None:
                assert codec is not None, "two chunks need the codec"
                chunk = begin_with(chunk.following, codec.next_reference(estimate(chunk.latents, pair, predicted)))
        return gradients, jnp.stack(losses, axis=1), jnp.stack(sigmas, axis=1)

    def _of_chunk(self, params: Any, chunk: Batch, pair: TrainingPair, shares: Array) -> tuple[Any, Array, Array]:
        """Gradients, losses [b] and prediction of one chunk, whose samples have these shares in the loss [b]."""

        def loss(params: Any) -> tuple[Array, tuple[Array, Array]]:
            predicted = nnx.merge(self.graph, gather_parameters(params))(pair.noisy, chunk.conditions, pair.sigma, chunk.text)
            losses = sample_losses(predicted, pair, chunk.shown)
            return (shares * losses).sum(), (losses, predicted)

        gradients, (losses, predicted) = jax.grad(loss, has_aux=True)(params)
        return self.place(gradients), losses, predicted


def sample_pairs(keys: Array, latents: Array, shift: float) -> TrainingPair:
    """`training_pair` of each sample with its own key [b]."""
    pairs = jax.vmap(lambda key, sample: training_pair(key, sample[None], shift))(keys, latents)
    return jax.tree.map(lambda leaf: leaf[:, 0], pairs)


def with_noisy_history(keys: Array, chunk: Batch, strength: float) -> Batch:
    """A chunk whose earlier frames, if it has any, are not as clean as recorded: a rollout's are its own predictions."""
    if "history" not in chunk.conditions or not strength:
        return chunk
    history = chunk.conditions["history"]
    keys = jax.vmap(jax.random.fold_in, (0, None))(keys, HISTORY_KEY)
    noise = jax.vmap(lambda key, sample: jax.random.normal(key, sample.shape, jnp.float32))(keys, history)
    return replace(chunk, conditions={**chunk.conditions, "history": history + strength * noise})


def estimate(latents: Array, pair: TrainingPair, predicted: Array) -> Array:
    """The clean latents [b t h w c] that a prediction of the velocity means, in one step; frame 0 is the given one."""
    clean = pair.noisy - pair.sigma[:, None, None, None, None] * predicted
    return jnp.concatenate([latents[:, :1], clean[:, 1:]], axis=1)


def begin_with(chunk: Batch, reference: Array) -> Batch:
    """A chunk whose first latent frame is not the true one but the given [b 1 h w c]."""
    return replace(chunk, latents=jnp.concatenate([reference, chunk.latents[:, 1:]], axis=1))


def chunk_weights(batch: Batch) -> Array:
    """[b k] each chunk's share in its sample's loss: equal over those that show the episode beyond their first frame."""
    if batch.following is None:
        return jnp.ones((len(batch.latents), 1), jnp.float32)
    later = batch.following.shown[:, 1:].any(axis=1).astype(jnp.float32)
    there = jnp.stack([jnp.ones(len(later)), later], axis=1)
    return there / there.sum(axis=1, keepdims=True)


def cut_rows(leaf: Array, parts: int) -> Array:
    """[b ...] -> [parts b/parts ...]: part i has rows i, i + parts, …, so that every device keeps rows of its own."""
    return leaf.reshape(-1, parts, *leaf.shape[1:]).swapaxes(0, 1)


def join_rows(leaf: Array) -> Array:
    """The inverse of `cut_rows`."""
    return leaf.swapaxes(0, 1).reshape(-1, *leaf.shape[2:])


def _sum(total: Any, more: Any) -> Any:
    return jax.tree.map(lambda a, b: a.astype(jnp.float32) + b.astype(jnp.float32), total, more)
