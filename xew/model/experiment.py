"""The config of a world-model experiment: what configs/*.yaml hold, and the parts that it is resolved into.

Fields without a default must be given. Functions elsewhere take the part that they need (`Experiment.network`, `.inputs`,
`.instructions`, `.encoding`, `.choice`, `.learning`, `.sampling`) and not the whole experiment.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from flax import nnx

from xew.config import ConfigError, load, pick
from xew.model.codecs.codec import CodecSettings, codec_class, latent_frames
from xew.model.conditions import ACTIONS, CONDITIONS, HISTORY, Condition, list_conditions
from xew.model.devices.sharding import MeshSettings
from xew.model.diffusion.samplers import SAMPLERS, SCHEDULES
from xew.model.network.dit import (
    MODELS,
    PATCH,
    STREAMS,
    AttentionName,
    ModelSize,
    RematName,
    TimeEmbedding,
    Visibility,
    WorldModel,
)
from xew.model.network.mechanisms import MECHANISMS
from xew.model.text.instructions import TEXT_ENCODERS, VOCABULARY, TextEncoder, TextSource, encode_instructions
from xew.model.video.frames import TEMPORAL_FACTOR
from xew.protocol import ACTION_DIM, SPLITS, Split


@dataclass(frozen=True)
class Clip:
    """What the model sees at once."""

    frames: int
    """4 k + 1; the first is given, the others are predicted."""
    height: int
    """Pixels; the camera's 320x240 is padded to this aspect ratio, then resized."""
    width: int


@dataclass(frozen=True)
class ModelSettings:
    size: str
    """One of MODELS."""
    action: str = "none"
    """One of ACTIONS: how the commanded motion is shown."""
    embodiment: str = "none"
    """One of CONDITIONS: how the robot's looks are shown."""
    history: tuple[int, ...] = ()
    """Earlier frames that are shown too, counted from the clip's first, as [-40, -20]; before the episode its first counts."""
    text: str = "learned"
    """One of TEXT_ENCODERS: a table of words that the network learns, or Wan's frozen encoder."""
    text_weights: Path | None = None
    """umt5: models_t5_umt5-xxl-enc-bf16.pth, or the text_encoder folder of the diffusers layout."""
    text_tokenizer: Path | None = None
    """umt5: the folder google/umt5-xxl, or the tokenizer folder of the diffusers layout."""
    text_prefix: str = ""
    """Put before every instruction, as FlowWAM's published weights expect it."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Of the matrix products."""
    residual: Literal["float32", "bfloat16"] = "float32"
    """Of the tokens between blocks; their sums are float32 either way."""
    remat: RematName = "none"
    """What the backward pass computes again: nothing, all but attention or matrix products, or everything (blocks.REMAT)."""
    unroll: int = 1
    """Blocks compiled as one loop body."""
    attention: AttentionName = "auto"
    """cuDNN's where it can be used, else XLA's (blocks.choose_attention)."""
    visibility: Visibility = "joint"
    """one_way: condition tokens see condition tokens only, and are computed once a clip when sampling. A departure."""
    time: TimeEmbedding = "exact"
    """flowwam: with the rounding under which FlowWAM's published weights were trained."""
    weights: Path | None = None
    """Published weights to start from: official Wan, diffusers, FlowWAM (dit_layouts.load_dit); from nothing if left out."""


@dataclass(frozen=True)
class TrainSettings:
    batch: int
    """Samples of one step over all devices."""
    steps: int = 0
    epochs: float = 0.0
    """Passes over the training samples; give this or `steps`."""
    seed: int = 0
    accumulate: int = 1
    """Parts of the batch that are computed one after another: less memory, the same step."""
    chunks: Literal[1, 2] = 1
    """Consecutive clips of a sample; the second starts from the predicted, not the true, end of the first."""
    learning_rate: float = 5e-5
    warmup_steps: int = 0
    decay_to: float = 1.0
    """Cosine decay of the learning rate to this part of its peak at the last step; 1 keeps it constant."""
    weight_decay: float = 0.01
    clip_norm: float = 1.0
    ema_decay: float = 0.0
    """0 keeps no average."""
    mu_dtype: Literal["float32", "bfloat16"] = "float32"
    """Of AdamW's first moment; bfloat16 saves two bytes a parameter."""
    shift: float = 5.0
    """Of the noise levels, in training and in sampling."""
    history_noise: float = 0.0
    """Standard deviation of what is added to earlier frames' latents in training; Ctrl-World has 0.3."""
    log_every: int = 20
    save_every: int = 1000
    sample_every: int = 1000
    """0 draws no samples."""
    keep_checkpoints: int = 2


@dataclass(frozen=True)
class AdaptSettings:
    """Adaptation of a trained run to robots that it has not seen, from a few episodes. Off without `start_from`."""

    start_from: Path | None = None
    """The run whose weights, at its latest checkpoint, are the start."""
    robots: tuple[str, ...] = ()
    """Whose episodes are learned from."""
    episodes: int = 1
    """Of each task and robot: the first so many accepted training seeds (M in the paper)."""
    replay: float = 0.0
    """Part of every batch that comes from the run's own training robots; 0 as in the paper."""
    lora_rank: int = 0
    """Learn corrections of this rank to the blocks' matrices instead of all weights; 0 as in the paper."""


@dataclass(frozen=True)
class RolloutSettings:
    sampler: str = "euler"
    """One of SAMPLERS."""
    grid: str = "flowwam"
    """Noise schedule: one of SCHEDULES, each by the name of the project that has it."""
    steps: int = 50
    """Evaluations of the network a chunk."""
    shift: float | None = None
    """Of the noise levels; that of training where left out."""
    guidance: float = 1.0
    """Classifier-free guidance against `negative_prompt`; 1 is none and costs nothing. Wan's own sampling has 5; networks
    trained here have never gone without their instruction."""
    negative_prompt: str = ""
    batch: int = 4
    """Episodes at once over all devices."""
    max_frames: int = 0
    """Predict only the first so many frames of an episode; 0 predicts all."""
    seed: int = 0


@dataclass(frozen=True)
class Network:
    """What the network is: everything that `create` needs."""

    size: ModelSize
    channels: int
    """Channels of the latents."""
    streams: tuple[str, ...]
    """Streams and mechanisms beside RGB."""
    words: int
    """Rows of the table of words that the network learns; 0 where a frozen encoder is used."""
    seed: int
    settings: ModelSettings

    def create(self) -> WorldModel:
        """Make the network at its random start; wrap in `nnx.eval_shape` for shapes only."""
        settings = self.settings
        return WorldModel(
            self.size,
            self.channels,
            self.streams,
            dtype=jnp.dtype(settings.dtype),
            residual=jnp.dtype(settings.residual),
            remat=settings.remat,
            unroll=settings.unroll,
            attention=settings.attention,
            visibility=settings.visibility,
            time=settings.time,
            history=tuple(frame / TEMPORAL_FACTOR for frame in settings.history),
            words=self.words,
            rngs=nnx.Rngs(self.seed),
        )


@dataclass(frozen=True)
class ClipInputs:
    """What the network is given of a clip: how it is cut, and which conditions go with it."""

    clip: Clip
    chunks: int
    """Consecutive clips of a training sample."""
    history: tuple[int, ...]
    """Earlier frames, counted from the clip's first."""
    conditions: dict[str, Condition]
    """Conditions by the stream or mechanism that each feeds; `.name` is a condition's name in the cache."""
    shapes: dict[str, tuple[int, ...]]
    """Shapes of a clip's arrays by stream or mechanism, rgb and text included: latents [t h w c], numbers [t n], text [l e] or
    [l]."""

    @property
    def latent_shape(self) -> tuple[int, ...]:
        """Shape [t h w c] of one RGB clip."""
        return self.shapes["rgb"]


@dataclass(frozen=True)
class Instructions:
    """How instructions become what the network takes."""

    encoder: TextEncoder
    source: TextSource
    prefix: str

    def encode(self, instructions: Iterable[str]) -> dict[str, np.ndarray]:
        """Every distinct instruction as the network takes it: [l] int32 where the table is learned, else [l e] float32."""
        return encode_instructions(self.encoder, self.source, instructions, self.prefix)


@dataclass(frozen=True)
class Encoding:
    """How episodes become latents, and where these are kept: everything that the latent cache depends on."""

    inputs: ClipInputs
    codec: CodecSettings
    folder: Path
    data: Path
    start_from: Path | None
    """Run whose codec and scales are used, in an adaptation."""

    @property
    def remedy(self) -> str:
        """What to do where the cache lacks something."""
        return f"run `python -m xew.model.latents CONFIG --data {self.data}`, with the other choices of this command too"


@dataclass(frozen=True)
class EpisodeChoice:
    """Which episodes of a data set a training reads."""

    data: Path
    split: Split
    adapt: AdaptSettings = AdaptSettings()
    replay: tuple[str, ...] = ()
    """Robots whose training episodes are replayed, in an adaptation with replay."""


@dataclass(frozen=True)
class Learning:
    """What is learned, and how: the network, the optimizer and the loss."""

    network: Network
    settings: TrainSettings
    lora_rank: int = 0


@dataclass(frozen=True)
class Experiment:
    data: Path
    """Episodes, made by `python -m xew.sim_warp.generate`."""
    out: Path
    """The run: config, checkpoints, TensorBoard, samples."""
    clip: Clip
    model: ModelSettings
    train: TrainSettings
    split: str = "fixed"
    """One of protocol.SPLITS: which robots train."""
    codec: CodecSettings = field(default_factory=CodecSettings)
    mesh: MeshSettings = field(default_factory=MeshSettings)
    adapt: AdaptSettings = AdaptSettings()
    rollout: RolloutSettings = RolloutSettings()
    cache: Path | None = None
    """Encoded streams; beside the data where left out."""

    @property
    def cache_folder(self) -> Path:
        return self.cache or beside(self.data, "latents")

    @property
    def robots(self) -> Split:
        return pick(SPLITS, self.split, "split")

    @property
    def conditions(self) -> dict[str, Condition]:
        """Conditions by the stream or mechanism that each feeds; `.name` is a condition's name in the cache."""
        return {condition.stream: condition for condition in pick_conditions(self.model)}

    @property
    def text_encoder(self) -> TextEncoder:
        return pick(TEXT_ENCODERS, self.model.text, "text encoder")

    @property
    def size(self) -> ModelSize:
        """Size of the network; the width of the text is its encoder's."""
        size, width = pick(MODELS, self.model.size, "model size"), self.text_encoder.width
        return replace(size, text_dim=width) if width else size

    @property
    def network(self) -> Network:
        words = VOCABULARY if self.text_encoder.learned else 0
        return Network(self.size, self.codec.channels, tuple(self.conditions), words, self.train.seed, self.model)

    @property
    def inputs(self) -> ClipInputs:
        history, conditions, size = self.model.history, self.conditions, self.size
        shapes = {"rgb": _latent_shape(self.clip, self.codec)}
        shapes |= {name: _condition_shape(shapes["rgb"], condition, len(history)) for name, condition in conditions.items()}
        shapes["text"] = (size.text_tokens,) if self.text_encoder.learned else (size.text_tokens, size.text_dim)
        return ClipInputs(self.clip, self.train.chunks, history, conditions, shapes)

    @property
    def instructions(self) -> Instructions:
        settings, folder = self.model, self.cache_folder / "text"
        source = TextSource(self.size.text_tokens, settings.text_weights, settings.text_tokenizer, folder)
        return Instructions(self.text_encoder, source, settings.text_prefix)

    @property
    def encoding(self) -> Encoding:
        return Encoding(self.inputs, self.codec, self.cache_folder, self.data, self.adapt.start_from)

    @property
    def choice(self) -> EpisodeChoice:
        """Which episodes are read. Raises ConfigError if the run that is replayed has gone."""
        start, replay = self.adapt.start_from, tuple[str, ...]()
        if start is not None and self.adapt.replay:
            source = load_experiment(start / "config.yaml").robots.train_robots
            replay = tuple(robot for robot in source if robot not in self.adapt.robots)
        return EpisodeChoice(self.data, self.robots, self.adapt, replay)

    @property
    def learning(self) -> Learning:
        return Learning(self.network, self.train, self.adapt.lora_rank)

    @property
    def sampling(self) -> RolloutSettings:
        """How rollouts are sampled, with the shift of training where none of its own is given."""
        return replace(self.rollout, shift=self.rollout.shift or self.train.shift)


def _latent_shape(clip: Clip, codec: CodecSettings) -> tuple[int, ...]:
    """Shape [t h w c] of one clip's latents."""
    factor = codec.spatial_factor
    return latent_frames(clip.frames), clip.height // factor, clip.width // factor, codec.channels


def _condition_shape(latents: tuple[int, ...], condition: Condition, history: int) -> tuple[int, ...]:
    """Shape of what a condition says of a clip of latents [t h w c]: latents [t h w c], or numbers [t n]."""
    stream, (frames, *picture) = condition.stream, latents
    width = ACTION_DIM if stream == "joints" else MECHANISMS[stream].width if stream in MECHANISMS else 0
    if width:
        return frames + (history if condition.with_history else 0), width
    return history if condition.make is None else frames, *picture


def beside(data: Path, ending: str) -> Path:
    """Name the folder next to the data that is called as they are, with an ending; also where they are "." or ".."."""
    named = data.resolve() if data.name in ("", "..") else data
    return named.with_name(f"{named.name}-{ending}")


def pick_conditions(settings: ModelSettings) -> list[Condition]:
    """Look up the conditions of action, embodiment and history. Raises ConfigError for a name that does not exist."""
    action, embodiment = pick(ACTIONS, settings.action, "action"), pick(CONDITIONS, settings.embodiment, "embodiment")
    return [*list_conditions(action), *list_conditions(embodiment), *([HISTORY] if settings.history else [])]


LEAST = {
    "clip.height": 1,
    "clip.width": 1,
    "model.unroll": 1,
    "train.batch": 1,
    "train.accumulate": 1,
    "train.learning_rate": 0,
    "train.warmup_steps": 0,
    "train.clip_norm": 0,
    "train.ema_decay": 0,
    "train.history_noise": 0,
    "train.log_every": 1,
    "train.save_every": 1,
    "train.sample_every": 0,
    "train.keep_checkpoints": 1,
    "adapt.lora_rank": 0,
    "rollout.steps": 1,
    "rollout.batch": 1,
    "rollout.max_frames": 0,
}
"""Numbers of an experiment that mean nothing below."""


def load_experiment(path: Path | str, overrides: list[str] | None = None) -> Experiment:
    """Read and check a config. Raises ConfigError with every choice that does not exist or does not fit."""
    experiment = load(Experiment, path, overrides or [])
    check_least(LEAST, experiment, str(path))
    codec_class(experiment.codec).check(experiment.codec)
    pick(SAMPLERS, experiment.rollout.sampler, "sampler")
    pick(SCHEDULES, experiment.rollout.grid, "noise schedule")
    _ = experiment.size, experiment.robots
    _check_conditions(experiment, str(path))
    _check_sizes(experiment, str(path))
    _check_training(experiment, str(path))
    _check_history(experiment, str(path))
    return experiment


def check_least(least: Mapping[str, float], settings: Any, source: str) -> None:
    """Raise ConfigError where a number of some settings, named as "train.batch", is under the least that it may be."""
    for name, smallest in least.items():
        value = attrgetter(name)(settings)
        if not value >= smallest:
            raise ConfigError(f"{source}: {name} is {value:g}; it must be at least {smallest:g}.")


def _check_conditions(experiment: Experiment, source: str) -> None:
    feeders: dict[str, str] = {}
    for condition in pick_conditions(experiment.model):
        if condition.stream == "rgb" or condition.stream not in {**STREAMS, **MECHANISMS}:
            known = ", ".join(name for name in (*STREAMS, *MECHANISMS) if name != "rgb")
            raise ConfigError(f"{source}: the condition {condition.name} feeds {condition.stream!r}; conditions feed {known}.")
        if condition.stream in feeders:
            raise ConfigError(
                f"{source}: {feeders[condition.stream]} and {condition.name} both feed {condition.stream}; choose one of them "
                "(model.action, model.embodiment)."
            )
        feeders[condition.stream] = condition.name


def _check_sizes(experiment: Experiment, source: str) -> None:
    clip, factor = experiment.clip, experiment.codec.spatial_factor * PATCH[1]
    if clip.frames < 5 or clip.frames % TEMPORAL_FACTOR != 1:
        near = max(5, clip.frames // TEMPORAL_FACTOR * TEMPORAL_FACTOR + 1)
        raise ConfigError(f"{source}: clip.frames is {clip.frames}; it must be 4 k + 1 and at least 5, for example {near}.")
    if clip.height % factor or clip.width % factor:
        found = f"clip is {clip.width}x{clip.height}"
        raise ConfigError(f"{source}: {found}; both sides must be multiples of {factor} (codec factor x patch).")


def _check_training(experiment: Experiment, source: str) -> None:
    train, adapt = experiment.train, experiment.adapt
    if (train.steps > 0) == (train.epochs > 0):
        raise ConfigError(f"{source}: train.steps is {train.steps}, train.epochs {train.epochs:g}; give one of them, over 0.")
    if train.ema_decay >= 1:
        raise ConfigError(f"{source}: train.ema_decay is {train.ema_decay:g}; it must be under 1.")
    for name, shift in {"train": train.shift, "rollout": experiment.rollout.shift}.items():
        if shift is not None and not shift > 0:
            raise ConfigError(f"{source}: {name}.shift is {shift:g}; it must be over 0 (1 leaves the levels as they are).")
    if adapt.start_from is None:
        if adapt != AdaptSettings():
            raise ConfigError(f"{source}: adapt says how, but adapt.start_from not which run to adapt; give that, or no adapt.")
        return
    if not adapt.robots or adapt.episodes < 1:
        raise ConfigError(f"{source}: adapt needs the robots to adapt to and at least one episode of each task and robot.")
    if not 0 <= adapt.replay < 1 or (adapt.replay and count_replayed(train.batch, adapt.replay) >= train.batch):
        raise ConfigError(
            f"{source}: adapt.replay is {adapt.replay:g} of a batch of {train.batch}; it is a part that leaves room for others."
        )


def count_replayed(batch: int, replay: float) -> int:
    """Number of samples of a batch that are replayed: the nearest whole one, at least one where any are asked for."""
    return max(1, round(batch * replay)) if replay else 0


def _check_history(experiment: Experiment, source: str) -> None:
    settings = experiment.model
    if any(frame >= 0 for frame in settings.history) or list(settings.history) != sorted(settings.history):
        found = f"{source}: model.history is {list(settings.history)}"
        raise ConfigError(f"{found}; give frames before the clip, the earliest first, as [-40, -20].")
    framed = [name for name in experiment.conditions if name in MECHANISMS and MECHANISMS[name].enters == "frame"]
    if settings.visibility == "one_way" and framed and settings.history:
        raise ConfigError(
            f"{source}: model.visibility one_way computes earlier frames without the poses that action {settings.action} tells "
            "them; use joint, or leave model.history out."
        )


def create_model(experiment: Experiment) -> WorldModel:
    """Make the network of an experiment at its random start; wrap in `nnx.eval_shape` for shapes only."""
    return experiment.network.create()
