"""The config of a world-model experiment (configs/*.yaml), and its parts.

The defaults are the recommended recipe of configs/fixed.yaml. Other functions take a part (`Experiment.network`, `.inputs`,
`.instructions`, `.encoding`, `.choice`, `.spec`) and not the whole experiment.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from xew.command_line import parse_command
from xew.config import admit, demand_admitted, load, pick
from xew.dataset import VIEWS, folder_beside, view_folder
from xew.model.codecs.codec import RUN_CODEC, codec_class, latent_size
from xew.model.codecs.contract import CodecSettings, latent_frames
from xew.model.codecs.vae import VAES
from xew.model.conditions import Condition
from xew.model.devices.sharding import MeshSettings
from xew.model.diffusion.samplers import SCHEDULES, NoiseSchedule
from xew.model.network.dit import MODELS, ModelSize
from xew.model.network.mechanisms import MECHANISMS
from xew.model.network.spec import Network
from xew.model.settings.checks import check_experiment
from xew.model.settings.parts import ClipInputs, Encoding, EpisodeChoice, TrainSpec, pick_conditions, sample_roles
from xew.model.settings.settings import AdaptSettings, Clip, ModelSettings, RolloutSettings, TrainSettings
from xew.model.text.instructions import TEXT_ENCODERS, VOCABULARY, Instructions, TextEncoder, TextSource
from xew.protocol import ACTION_DIM, HEAD, SPLITS, Split, expand_robots

F = TypeVar("F")


@dataclass(frozen=True)
class Experiment:
    data: Path
    """Episodes, made by `python -m xew.sim_warp.generate`."""
    out: Path
    """Folder of the run: config, checkpoints, TensorBoard, samples."""
    view: str = HEAD
    """View of the data set: head, or one that `inspect --render --cameras` has added, such as wrist_left."""
    split: str = "fixed"
    """One of protocol.SPLITS, which gives the training robots."""
    clip: Clip = field(default_factory=Clip)
    codec: CodecSettings = field(default_factory=CodecSettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    mesh: MeshSettings = field(default_factory=MeshSettings)
    adapt: AdaptSettings = field(default_factory=AdaptSettings)
    rollout: RolloutSettings = field(default_factory=RolloutSettings)
    cache: Path | None = None
    """Folder of encoded streams; by default next to the data."""

    @property
    def cache_folder(self) -> Path:
        data = self.data.resolve() if self.data.name in ("", "..") else self.data
        folder = self.cache or folder_beside(data, "latents")
        return folder if self.view == HEAD else folder / VIEWS / self.view

    @property
    def episodes(self) -> Path:
        """The data set of the view. Raises EpisodeError if the data do not have it."""
        return view_folder(self.data, self.view)

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
        """Size of the network, with the text encoder's width."""
        size, width = pick(MODELS, self.model.size, "model size"), self.text_encoder.width
        return replace(size, text_dim=width) if width else size

    @property
    def network(self) -> Network:
        words = VOCABULARY if self.text_encoder.learned else 0
        own = ("reference_channels",) if self.model.reference == "channels" else ()
        guess = next((name for name, condition in self.conditions.items() if condition.is_guess), "")
        streams = (*self.conditions, *own)
        return Network(self.size, latent_size(self.codec).channels, streams, guess, words, self.train.seed, self.model)

    @property
    def inputs(self) -> ClipInputs:
        history, conditions, size = self.model.history, self.conditions, self.size
        shapes = {"rgb": _latent_shape(self.clip, self.codec)}
        shapes |= {name: _condition_shape(shapes["rgb"], condition, len(history)) for name, condition in conditions.items()}
        shapes["text"] = (size.text_tokens,) if self.text_encoder.learned else (size.text_tokens, size.text_dim)
        return ClipInputs(self.clip, self.train.chunks, history, conditions, shapes, size.patch)

    @property
    def instructions(self) -> Instructions:
        settings, folder = self.model, self.cache_folder / "text"
        source = TextSource(self.size.text_tokens, settings.text_weights, settings.text_tokenizer, folder)
        return Instructions(self.text_encoder, source, settings.text_prefix)

    @property
    def encoding(self) -> Encoding:
        autoencoder = pick(VAES, self.codec.vae, "autoencoder") if self.codec.name == "wan_vae" else None
        start_from, kind = self.adapt.start_from, codec_class(self.codec)
        return Encoding(self.inputs, self.codec, kind, self.cache_folder, self.data, start_from, autoencoder)

    @property
    def choice(self) -> EpisodeChoice:
        """Selection of episodes. Raises ConfigError if the replayed run no longer exists."""
        adapt, targets, replay = self.adapt, expand_robots(self.adapt.robots), tuple[str, ...]()
        samples = sample_roles(self.robots, targets) if self.train.samples else {}
        if adapt.start_from is None:
            return EpisodeChoice(self.robots.train_robots, samples=samples, motion=self.robots.motion)
        if adapt.replay:
            source = load_recorded(adapt.start_from / "config.yaml").robots.train_robots
            replay = tuple(robot for robot in source if robot not in targets)
        return EpisodeChoice(targets, adapt.episodes, replay, samples=samples, motion=self.robots.motion)

    @property
    def spec(self) -> TrainSpec:
        """Training specification; `TrainSpec.with_steps` sets the steps of a run whose length is in epochs."""
        return TrainSpec(self.network, self.inputs, self.train, self.adapt.replay, self.adapt.lora_rank)

    @property
    def schedule(self) -> NoiseSchedule:
        """Noise schedule of rollouts."""
        make = pick(SCHEDULES, self.rollout.noise_schedule, "noise schedule")
        return make(self.rollout.steps, self.train.shift)


def _latent_shape(clip: Clip, codec: CodecSettings) -> tuple[int, ...]:
    """Shape [t h w c] of one clip's latents."""
    factor, channels = latent_size(codec)
    return latent_frames(clip.frames), clip.height // factor, clip.width // factor, channels


def _condition_shape(latents: tuple[int, ...], condition: Condition, history: int) -> tuple[int, ...]:
    """Shape of a condition for a clip of latents [t h w c]: latents [t h w c], or numbers [t n]."""
    stream, (frames, *picture) = condition.stream, latents
    width = ACTION_DIM if stream == "joints" else MECHANISMS[stream].width if stream in MECHANISMS else 0
    if width:
        return frames + (history if condition.with_history else 0), width
    return history if condition.make is None else frames, *picture


def load_experiment(path: Path | str, overrides: Sequence[str] = ()) -> Experiment:
    """Read and check a config. Raises ConfigError for a setting that does not exist or does not fit."""
    experiment = load(Experiment, path, overrides)
    check_experiment(experiment, str(path))
    return experiment


def load_recorded(path: Path) -> Experiment:
    """Read and check the config of a run, which may come from someone else.

    Raises:
        UntrustedError: it names a module that the user has not admitted.
        ConfigError: as `load_experiment`.
    """
    experiment = load(Experiment, path)
    if experiment.codec.weights is not None and any((path.parent / RUN_CODEC).glob("[!.]*")):  # the weights may have moved
        experiment = replace(experiment, codec=replace(experiment.codec, weights=path.parent / RUN_CODEC))
    demand_admitted(experiment, str(path))
    check_experiment(experiment, str(path))
    return experiment


def parse_experiment(flags: type[F], arguments: Sequence[str] | None, prog: str, description: str) -> tuple[F, Experiment]:
    """Parse a command line of a config, the command's flags and overrides of the config, and check the config.

    Raises:
        ConfigError: no config is named, or a setting does not exist or does not fit.
        SystemExit: an option is unknown or malformed (code 2), or asks for --help (code 0).
    """
    command = parse_command(
        flags, Experiment, functools.partial(load, Experiment), arguments, prog=prog, description=description
    )
    admit(getattr(command.flags, "trust", ()))
    check_experiment(command.config, str(command.path))
    return command.flags, command.config
