"""One compiled training step of an autoencoder: augmentation, loss, gradients, update."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax import Array, lax
from jaxtyping import Float, Key, UInt8

from lab.codec.sampling import Batch
from lab.codec.settings import CodecExperiment, CodecTrainSettings
from xew.model.codecs.contract import to_signed
from xew.model.codecs.conv_autoencoder import ConvAutoencoder
from xew.model.codecs.vae import LatentStatistic
from xew.model.runs.checkpoint import TrainState

Clip = Float[Array, "t h w 3"]
Clips = Float[Array, "b t h w 3"]


class Losses(NamedTuple):
    """Parts of the loss of one step, each a scalar."""

    total: Array
    l1: Array
    mse: Array
    lpips: Array
    penalty: Array
    psnr: Array
    """Decibels, of the batch."""
    gradient_norm: Array
    finite: Array
    """Whether the loss and the gradients are finite."""


def unpack_regions(regions: UInt8[Array, "b bytes h w"], frames: int) -> Float[Array, "b t h w 1"]:
    """Unpack masks [b k h w], one bit per frame from the highest on, to [b t h w 1] float32, 1 or 0."""
    parts = [(regions[:, time // 8] >> np.uint8(7 - time % 8)) & np.uint8(1) for time in range(frames)]
    return jnp.stack(parts, axis=1)[..., None].astype(jnp.float32)


def augment(
    keys: Key[Array, " b"], clips: Clips, regions: Float[Array, "b t h w 1"], settings: CodecTrainSettings
) -> tuple[Float[Array, "b t y x 3"], Float[Array, "b t y x 1"]]:
    """Augment clips [b t h w 3] in [-1, 1] and masks of the robot [b t h w 1], see `CodecTrainSettings`."""
    return jax.vmap(functools.partial(_augment_one, settings))(keys, clips, regions)


def _augment_one(settings: CodecTrainSettings, key: Array, clip: Array, region: Array) -> tuple[Array, Array]:
    still_key, permute_key, flip_key, jitter_key = jax.random.split(key, 4)
    both = jnp.concatenate([clip, region], axis=-1)
    if settings.still:
        one, two = jax.random.split(still_key)
        frame = lax.dynamic_index_in_dim(both, jax.random.randint(two, (), 0, len(both)), 0, keepdims=True)
        both = jnp.where(jax.random.uniform(one) < settings.still, jnp.broadcast_to(frame, both.shape), both)
    if settings.flip:
        both = jnp.where(jax.random.uniform(flip_key) < 0.5, both[:, :, ::-1], both)
    clip, region = both[..., :3], both[..., 3:]
    if settings.permute:
        one, two = jax.random.split(permute_key)
        order = jnp.where(jax.random.uniform(one) < settings.permute, jax.random.permutation(two, 3), jnp.arange(3))
        channels = [clip[..., number] for number in range(3)]
        clip = jnp.stack([lax.select_n(order[number], *channels) for number in range(3)], axis=-1)
    if settings.jitter:
        one, two, three = jax.random.split(jitter_key, 3)
        limit = jnp.where(jax.random.uniform(one) < 0.5, settings.jitter, 0.0)
        gain, offset = (limit * jax.random.uniform(k, (1, 1, 1, 3), minval=-1.0, maxval=1.0) for k in (two, three))
        clip = jnp.clip(clip * (1 + gain) + offset, -1, 1)
    return clip, region


def reconstruct_groups(module: ConvAutoencoder, groups: Clips, key: Key[Array, ""], noise: float) -> tuple[Clips, Array]:
    """Reconstruct groups [b 4 h w 3] from noisy latents, not clipped; returns them and the latents' mean square."""
    latents = module.encode_groups(groups)
    noisy = latents + noise * jax.random.normal(key, latents.shape, latents.dtype)
    return module.decode_groups(noisy), jnp.square(latents).mean()


def codec_losses(
    module: ConvAutoencoder, clips: Clips, weights: Float[Array, "b t h w 1"], key: Key[Array, ""], settings: CodecTrainSettings
) -> Losses:
    """The loss of clips [b t h w 3] in [-1, 1], with weights [b t h w 1] of pixels in l1 and mse."""
    from xew.metrics import lpips

    latent_key, frame_key = jax.random.split(key)
    decoded, penalty = reconstruct_groups(module, clips, latent_key, settings.noise)
    difference = decoded - clips
    norm = 3 * weights.sum()
    l1, mse = (weights * jnp.abs(difference)).sum() / norm, (weights * jnp.square(difference)).sum() / norm
    perceptual = jnp.float32(0)
    if settings.lpips:
        frames, truth = (_some_frames(x, frame_key, settings.lpips_frames) for x in (decoded, clips))
        chunk = len(frames) if jax.default_backend() == "gpu" else max(len(frames) // len(clips), 1)
        perceptual = lpips(frames, truth, chunk=chunk, exact=False).mean()
    psnr = -10 * jnp.log10(jnp.square((jnp.clip(decoded, -1, 1) - clips) / 2).mean() + 1e-10)
    total = settings.l1 * l1 + settings.mse * mse + settings.lpips * perceptual + settings.penalty * penalty
    return Losses(total, l1, mse, perceptual, penalty, psnr, jnp.float32(0), jnp.isfinite(total))


def _some_frames(clips: Array, key: Array, count: int) -> Array:
    """Frames [n h w 3] in [0, 1] of clips [b t h w 3] at `count` random times, the same for all clips; 0 takes all."""
    frames = clips.shape[1]
    if 0 < count < frames:
        clips = jnp.take(clips, jax.random.choice(key, frames, (count,), replace=False), axis=1)
    return (jnp.clip(clips, -1, 1).reshape(-1, *clips.shape[2:]) + 1) / 2


def make_codec_optimizer(settings: CodecTrainSettings) -> optax.GradientTransformation:
    """AdamW after clipping by the global norm, without the learning rate, an input of each step."""
    return optax.chain(
        optax.clip_by_global_norm(settings.clip_norm),
        optax.scale_by_adam(),
        optax.add_decayed_weights(settings.weight_decay),
    )


def make_codec_step(
    graph: nnx.GraphDef, statistics: Any, experiment: CodecExperiment
) -> Callable[[TrainState, Batch], tuple[TrainState, Losses]]:
    """The compiled step; its noise depends only on the seed and the step, so a resumed run repeats it."""
    settings, optimizer = experiment.train, make_codec_optimizer(experiment.train)

    @functools.partial(jax.jit, donate_argnums=0)
    def step(state: TrainState, batch: Batch) -> tuple[TrainState, Losses]:
        key = jax.random.fold_in(jax.random.key(settings.seed), state.step)
        augment_key, loss_key = jax.random.split(key)
        b, frames = batch.clips.shape[:2]
        if batch.regions is None:
            regions = jnp.zeros((*batch.clips.shape[:-1], 1), jnp.float32)
        else:
            regions = unpack_regions(batch.regions, frames)
        clips, regions = augment(jax.random.split(augment_key, b), to_signed(batch.clips), regions, settings)
        weights = 1 + settings.region * regions

        def loss(params: Any) -> tuple[jax.Array, Losses]:
            losses = codec_losses(nnx.merge(graph, params, statistics), clips, weights, loss_key, settings)
            return losses.total, losses

        (_, losses), gradients = jax.value_and_grad(loss, has_aux=True)(state.params)
        updates, moments = optimizer.update(gradients, state.optimizer, state.params)
        params = optax.apply_updates(state.params, jax.tree.map(lambda update: -batch.rate * update, updates))
        # A shorter average over the first steps, to forget the random start.
        decay = jnp.minimum(settings.ema_decay, (1 + state.step) / (10 + state.step))
        ema = optax.incremental_update(params, state.ema, 1 - decay)
        norm = optax.tree.norm(gradients)
        losses = losses._replace(gradient_norm=norm, finite=losses.finite & jnp.isfinite(norm))
        return TrainState(state.step + 1, params, moments, ema), losses

    return step


def init_codec_state(experiment: CodecExperiment) -> tuple[nnx.GraphDef, Any, TrainState]:
    """Structure, initial statistics of the latents (0 and 1) and the state of step 0."""
    key = jax.random.key(experiment.train.seed, impl="unsafe_rbg")  # other generators take a minute to compile

    def create() -> nnx.Module:
        return ConvAutoencoder(experiment.autoencoder, dtype=jnp.dtype(experiment.dtype), rngs=nnx.Rngs(key))

    graph: nnx.GraphDef = nnx.split(nnx.eval_shape(create))[0]
    optimizer = make_codec_optimizer(experiment.train)

    @jax.jit
    def init() -> tuple[Any, TrainState]:
        module = create()
        params, statistics = nnx.state(module, nnx.Param), nnx.state(module, LatentStatistic)
        return statistics, TrainState(jnp.int32(0), params, optimizer.init(params), jax.tree.map(jnp.copy, params))

    statistics, state = init()
    return graph, statistics, state


def summarize(results: Sequence[Losses]) -> dict[str, float]:
    """Means of the parts of the loss over some steps."""
    names = [name for name in Losses._fields if name != "finite"]
    means = {name: float(np.mean([getattr(result, name) for result in results])) for name in names}
    return {"loss/train": means.pop("total")} | {f"train/{name}": value for name, value in means.items()}
