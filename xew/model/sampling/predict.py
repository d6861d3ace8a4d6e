"""Autoregressive prediction: a trained network continues episodes from their first frame and their commands.

Reads  episodes (first frame, instruction, commands)
Writes uint8 video at the model's size

Long episodes are predicted in chunks; the last frame of a chunk is the reference of the next. The noise depends on the seed,
the episode and the chunk. Batches are sharded over the mesh of the parameters.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from xew.concurrency import map_in_order
from xew.config import pick
from xew.dataset import Episode, name_number
from xew.episode import Record
from xew.model.cache.clips import codec_digest, gives_render
from xew.model.cache.scales import Scale, apply_scales
from xew.model.codecs.contract import Codec, GivenFrames, encode_pictures, to_pictures, to_signed
from xew.model.conditions import clip_numbers
from xew.model.devices.sharding import batch_sharding, replicated_sharding
from xew.model.diffusion.samplers import SAMPLERS, NoiseSchedule
from xew.model.experiment import Experiment
from xew.model.network.dit import WorldModel, cast_params, network_graph
from xew.model.sampling.reading import FIRST, RENDER, SCENE, EpisodeInputs, EpisodeReader, Streams
from xew.model.settings.parts import ClipInputs
from xew.model.settings.settings import RolloutSettings
from xew.model.text.instructions import Instructions
from xew.rollout import CODEC

T = TypeVar("T")


class ChunkInputs(NamedTuple):
    """Input of the network for one chunk of each episode of a batch."""

    reference: Array
    """[b 1 h w 3] uint8, first frame of the chunk."""
    conditions: Mapping[str, Array]
    """Stream or mechanism -> [b t' h' w' c] latents or [b t' n] numbers, scaled."""
    text: Array
    """[b l e] or [b l]."""
    negative: Array | None
    """The same of the negative prompt, or None without guidance."""
    names: Array
    """[b] uint32, numbers of the episodes, for their noise."""
    chunk: Array | int
    """Number of the chunk."""
    given: GivenFrames | None = None
    """Render and scene for the codec's decoder, or None."""


class Continuation(NamedTuple):
    """A batch of episodes while it is being predicted, chunk by chunk."""

    first: Array
    """[b 1 h w 3] uint8, first frames."""
    unaligned: Mapping[str, Array]
    """Latents of the pictures that every chunk reuses, by stream."""
    text: Array
    """As in `ChunkInputs`."""
    negative: Array | None
    """As in `ChunkInputs`."""
    names: Array
    """[b] uint32, numbers of the episodes, for their noise."""
    chunks: list[Array]
    """Chunks of frames [b t h w 3] uint8 predicted so far."""


class ChunkSampling(NamedTuple):
    """Sampler settings; hashable, static in the compiled function."""

    sampler: str
    schedule: NoiseSchedule
    guidance: float
    latent_shape: tuple[int, ...]
    seed: int


class Prediction(NamedTuple):
    """A prediction, perhaps still being computed."""

    chunks: list[Array]
    """Chunks of frames [b t h w 3] uint8; each begins with the last frame of the previous one."""
    episodes: int
    frame_count: int

    def fetch(self) -> np.ndarray:
        """Wait for all frames: uint8 [episodes frame_count h w 3]."""
        frames = [np.asarray(chunk)[: self.episodes, min(number, 1) :] for number, chunk in enumerate(self.chunks)]
        return np.concatenate(frames, axis=1)[:, : self.frame_count]


@dataclass(frozen=True)
class Predictor:
    """A trained model that continues videos."""

    inputs: ClipInputs
    instructions: Instructions
    settings: RolloutSettings
    schedule: NoiseSchedule
    codec: Codec
    graph: nnx.GraphDef
    params: Any
    """Parameters on one device, or on a mesh (`xew.model.devices.sharding`), over which batches are sharded."""
    scales: Mapping[str, Scale] = field(default_factory=dict)
    """Scales of numeric conditions, as in training."""

    def predict(self, episodes: Sequence[Episode], frame_count: int) -> np.ndarray:
        """Predict the first `frame_count` frames of each episode: uint8 [b t h w 3] at the model's size.

        Frame 0 is the codec's reconstruction of the first frame. Results do not depend on the batch.
        """
        return self.begin(list(self.reader.read_ahead(episodes)), frame_count).fetch()

    def begin(self, episodes: Sequence[EpisodeInputs], frame_count: int, batch: int = 1) -> Prediction:
        """Start to predict the first `frame_count` frames of episodes that were read, without waiting for the devices.

        `batch` as in `start`.
        """
        started, streams = self.start(episodes, batch), [streams for _, streams in episodes]
        for _ in range(0, max(frame_count - 1, 1), self.inputs.clip.frames - 1):
            self.extend(started, streams)
        return Prediction(started.chunks, len(episodes), frame_count)

    def start(self, episodes: Sequence[EpisodeInputs], batch: int = 1) -> Continuation:
        """Encode what all chunks of episodes share; of aligned streams it needs none.

        The last episode is repeated to fill `batch` and the devices, so no smaller batch is compiled.
        """
        size = max(len(episodes), batch)
        padded = _fill_up(episodes, size + -size % self._devices)
        records, streams = [record for record, _ in padded], [streams for _, streams in padded]
        text, negative = self._encode_text(records)
        names = self._place(np.array([name_number(record) for record in records], np.uint32))
        (first,) = self._join(streams, {FIRST: np.zeros(1, int)}).values()
        return Continuation(first, self._encode_unaligned(streams), text, negative, names, [])

    def extend(self, started: Continuation, episodes: Sequence[Streams]) -> Array:
        """Predict the next chunk [b t h w 3] uint8, without waiting for the devices; it begins with the last frame so far.

        Args:
            started: the batch, to which the chunk is added.
            episodes: streams of each episode, at least of all frames so far and of the chunk; their ends are repeated.
        """
        first, chunks = started.first, started.chunks
        streams, number = _fill_up(episodes, len(first)), len(chunks)
        start = number * (self.inputs.clip.frames - 1)
        history = self._encode_history(first, chunks, start)
        aligned, given = self._encode_aligned(streams, start)
        reference, conditions = chunks[-1][:, -1:] if chunks else first, {**started.unaligned, **history, **aligned}
        inputs = ChunkInputs(reference, conditions, started.text, started.negative, started.names, number, given)
        with jax.set_mesh(self._mesh) if self._mesh is not None else nullcontext():
            chunks.append(predict_chunk(self.graph, self.params, self.codec, inputs, self._sampling))
        return chunks[-1]

    @property
    def _sampling(self) -> ChunkSampling:
        settings = self.settings
        return ChunkSampling(settings.sampler, self.schedule, settings.guidance, self.inputs.latent_shape, settings.seed)

    @property
    def header(self) -> dict[str, str]:
        """What rollouts say of the predictor: the digest of its codec, whose truth is the noise floor of their scores."""
        return {CODEC: codec_digest(self.codec, self.inputs.clip, self.inputs.conditions)}

    @property
    def reader(self) -> EpisodeReader:
        """Reader of the inputs of `begin` and `start`."""
        conditions = self.inputs.conditions
        return EpisodeReader(conditions, self.inputs.clip, gives_render(self.codec, conditions))

    def _join(self, episodes: Sequence[Streams], frames: Mapping[str, np.ndarray]) -> dict[str, Array]:
        """These frames of picture streams of every episode, [b t h w 3] on the devices; ends of episodes are repeated.

        A thread a stream sends them, episode by episode, because joining them on the host first takes longer than sending them.
        """

        def join(name: str) -> Array:
            videos = [_cut(streams[name], frames[name]) for streams in episodes]
            return self._place(_stack(videos) if jax.process_count() == 1 else np.stack(videos))

        return dict(zip(frames, map_in_order(join, frames), strict=True))

    def _choose_given(self, episodes: Sequence[Streams], start: int) -> dict[str, np.ndarray]:
        """Frames that the decoder is given of the chunk that begins at frame `start`, of each stream; as `given_frames`."""
        if RENDER not in episodes[0]:
            return {}
        end = start + self.inputs.clip.frames
        moves = any(len(streams[SCENE]) > 1 for streams in episodes)
        return {RENDER: np.arange(start - 1, end + 1), SCENE: np.arange(start, end if moves else start + 1)}

    def _encode_text(self, records: Sequence[Record]) -> tuple[Any, Any]:
        """Encode the instructions and, with guidance, as many negative prompts."""
        settings = self.settings
        instructions = [record.instruction for record in records]
        encoded = self.instructions.encode(instructions)
        text = self._place(np.stack([encoded[instruction] for instruction in instructions]))
        if settings.guidance == 1:
            return text, None
        negative = self.instructions.encode([settings.negative_prompt])[settings.negative_prompt]
        return text, self._place(np.stack([negative] * len(records)))

    def _encode_unaligned(self, episodes: Sequence[Streams]) -> dict[str, Array]:
        """Encode the pictures that every chunk reuses."""
        names = [name for name, c in self.inputs.conditions.items() if c.make is not None and not c.aligned]
        joined = self._join(episodes, {name: np.arange(len(episodes[0][name])) for name in names})
        return {name: encode_pictures(self.codec, pictures) for name, pictures in joined.items()}

    def _encode_aligned(self, episodes: Sequence[Streams], start: int) -> tuple[dict[str, Array], GivenFrames | None]:
        """Encode aligned conditions of the chunk that begins at frame `start`; with what its decoder is given."""
        frames, history = self.inputs.clip.frames, self.inputs.history
        pictures, numbers = self._choose_given(episodes, start), {}
        for name, condition in self.inputs.conditions.items():
            if condition.make is None or not condition.aligned:
                continue
            if episodes[0][name].ndim == 2:
                clips = [clip_numbers(condition, streams[name], start, frames, history) for streams in episodes]
                numbers[name] = np.stack(clips)
            else:
                pictures[name] = np.arange(start, start + frames)
        joined = self._join(episodes, pictures)
        given = GivenFrames(joined.pop(RENDER), joined.pop(SCENE)) if RENDER in joined else None
        encoded = {name: encode_pictures(self.codec, frames) for name, frames in joined.items()}
        scaled = apply_scales(self.scales, self.inputs.conditions, numbers)
        return encoded | {name: self._place(array) for name, array in scaled.items()}, given

    def _encode_history(self, first: Array, chunks: Sequence[Array], start: int) -> dict[str, Array]:
        """Encode earlier frames of the prediction one by one."""
        names = [name for name, condition in self.inputs.conditions.items() if condition.make is None]
        if not names:
            return {}
        earlier = np.maximum(start + np.asarray(self.inputs.history), 0)
        encoded = [encode_pictures(self.codec, self._find_frame(first, chunks, int(frame))) for frame in earlier]
        return dict.fromkeys(names, jnp.concatenate(encoded, axis=1))

    def _find_frame(self, first: Array, chunks: Sequence[Array], frame: int) -> Array:
        """A frame [b 1 h w 3] of what was predicted; where it lies is no constant of the compiled slice."""
        if frame == 0:
            return first
        number, place = divmod(frame - 1, self.inputs.clip.frames - 1)
        return jax.lax.dynamic_slice_in_dim(chunks[number], place + 1, 1, axis=1)

    @property
    def _mesh(self) -> Mesh | None:
        sharding = jax.tree.leaves(self.params)[0].sharding
        mesh = sharding.mesh if isinstance(sharding, NamedSharding) else None
        return mesh if isinstance(mesh, Mesh) else None

    @property
    def _devices(self) -> int:
        """Number of devices over which a batch is sharded. With several processes each holds the whole batch."""
        return math.prod(self._mesh.devices.shape) if self._mesh is not None and jax.process_count() == 1 else 1

    def _place(self, array: Any) -> Any:
        """Put an array [b ...] on the devices."""
        if self._mesh is None:
            return jnp.asarray(array)
        return jax.device_put(array, batch_sharding(self._mesh) if self._devices > 1 else replicated_sharding(self._mesh))


def _cut(video: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Consecutive frames of a video [t h w 3], whose ends are repeated; a view if it has all of them."""
    if frames[0] >= 0 and frames[-1] < len(video):
        return video[frames[0] : frames[-1] + 1]
    return video.take(frames, axis=0, mode="clip")


@jax.jit
def _stack(videos: list[Array]) -> Array:
    return jnp.stack(videos)


def _fill_up(items: Sequence[T], size: int) -> list[T]:
    """A list of `size` items, of which the last is repeated."""
    return [*items, *[items[-1]] * (size - len(items))]


def make_predictor(experiment: Experiment, codec: Codec, params: Any, scales: Mapping[str, Scale]) -> Predictor:
    """The predictor of an experiment with these parameters."""
    graph, settings = network_graph(experiment.network.for_sampling), experiment.rollout
    return Predictor(experiment.inputs, experiment.instructions, settings, experiment.schedule, codec, graph, params, scales)


@functools.partial(jax.jit, static_argnums=(0, 4))
def predict_chunk(graph: nnx.GraphDef, params: Any, codec: Any, inputs: ChunkInputs, sampling: ChunkSampling) -> Array:
    """Predict one chunk of every episode of a batch: uint8 [b t h w 3]."""
    model = nnx.merge(graph, cast_params(graph, params))
    reference = codec.encode_batch(to_signed(inputs.reference))
    noise = jax.vmap(lambda name: draw_noise(name, inputs.chunk, sampling))(inputs.names)
    velocity, sampler = guided_velocity(model, inputs, sampling.guidance), pick(SAMPLERS, sampling.sampler, "sampler")
    frames = to_pictures(codec.decode_batch(sampler(velocity, reference, noise, sampling.schedule), inputs.given))
    return jax.lax.with_sharding_constraint(frames, PartitionSpec()) if jax.process_count() > 1 else frames


def draw_noise(name: Array, chunk: Array | int, sampling: ChunkSampling) -> Array:
    """Noise [t h w c] float32 of a chunk of an episode; traced, because fetching a key would wait for all chunks before it."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(sampling.seed), name), chunk)
    return jax.random.normal(key, sampling.latent_shape, jnp.float32)


def guided_velocity(model: WorldModel, inputs: ChunkInputs, guidance: float) -> Callable[[Array, Array], Array]:
    """Make the network's velocity, with guidance if there is a negative prompt, as a function of latents and noise level."""
    wanted = _make_velocity(model, inputs.conditions, inputs.text)
    if inputs.negative is None:
        return wanted
    unwanted = _make_velocity(model, inputs.conditions, inputs.negative)

    def velocity(latents: Array, level: Array) -> Array:
        away = unwanted(latents, level)
        return away + guidance * (wanted(latents, level) - away)

    return velocity


def _make_velocity(model: WorldModel, conditions: Mapping[str, Array], text: Array) -> Callable[[Array, Array], Array]:
    cache = model.condition_cache(conditions, text) if model.one_way and model.condition_streams else None
    return lambda latents, level: model(latents, conditions, level, text, cache)
